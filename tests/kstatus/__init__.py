"""kstatus, by which Flux, kpt and others judge objects, and the Lua in which Argo CD does: built from pinned source.

`python -m tests.kstatus` builds what is missing, in `${XDG_CACHE_HOME:-~/.cache}/wayside/kstatus/<hash>/`: some twenty
seconds of one core, once.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from tests.gobuild import BuildError, GoModule

MODULE = GoModule("kstatus", Path(__file__).parent / "module", {"kstatus": "."})


def judged(objects: Sequence[Mapping[str, Any]], script: Path) -> list[tuple[str, str]]:
    """The status of each object by kstatus, and its health by Argo CD's script. Raises BuildError.

    kstatus has Current, InProgress, Failed, Terminating and Unknown, Argo CD Healthy, Progressing, Degraded and
    Suspended.
    """
    program = MODULE.ensure(Console(stderr=True)) / "kstatus"
    lines = "".join(f"{json.dumps(each)}\n" for each in objects)
    done = subprocess.run([program, script], input=lines, capture_output=True, text=True, check=True)
    found = [line.partition("\t") for line in done.stdout.splitlines()]
    return [(status, health) for status, _, health in found]


def main() -> int:
    """Build what is missing."""
    try:
        print(MODULE.ensure(Console(stderr=True)))
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
