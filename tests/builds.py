"""Builds everything that the tests need once, in parallel: `python -m tests.builds`.

`make test` runs it in parallel to lint and the unit tests, which need no builds. The longest build starts first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from rich.console import Console

from tests import helm, kstatus, mongodb, s3
from tests.cluster import binaries
from tests.e2e import programs
from tests.e2e.images import ImageError, lasting_layers
from tests.e2e.privileges import why_no_node

AT_ONCE = 2  # each compiles on all cores; a second one works while the first one links


def image() -> int:
    """Build the cached layers of the project's image, if this machine can run a node."""
    if why_no_node() is not None:
        return 0
    console = Console(stderr=True)
    try:
        programs.install(console)
        lasting_layers(console)
    except (ImageError, programs.ProgramsUnavailableError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


BUILDS: tuple[Callable[[], int], ...] = (
    binaries.main,
    programs.main,
    image,
    helm.main,
    kstatus.main,
    mongodb.main,
    s3.main,
)
"""Each prints the path of its build or the reason for a failure, and returns an exit code."""


def main() -> int:
    """Build everything; exit code 1 if a build failed."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return max(pool.map(lambda build: build(), BUILDS))


if __name__ == "__main__":
    sys.exit(main())
