"""Both programs can be ended before they have imported what they need."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping

import pytest

from tests.patience import PATIENCE
from tests.programs import PROGRAMS, Name
from wayside.process.startup import ENDED

CLIS: Mapping[Name, str] = {
    "detector": "detector.commands.cli",
    "application-manager": "application_manager.commands.cli",
}
"""The modules whose imports are slow."""

WHILE_IT_IMPORTS = """
import os, signal, sys, threading
import {program} as program

class Cli:
    def find_spec(self, name, path=None, target=None):
        if name == "{cli}":
            print(sorted(set(sys.modules) & {{"typer", "pydantic", "kubernetes", "zenoh", "kopf"}}), flush=True)
            os.kill(os.getpid(), signal.SIGTERM)
            threading.Event().wait()

sys.meta_path.insert(0, Cli())
program.main()
"""
"""The import of the other modules sends SIGTERM and then hangs. Without a handler, SIGTERM does not end the first
process of a container, and ends any other process by the signal itself."""


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_stopped_during_its_imports_ends(name: Name) -> None:
    code = WHILE_IT_IMPORTS.format(program=PROGRAMS[name], cli=CLIS[name])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (ENDED, "[]\n")
