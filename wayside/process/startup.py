"""Process start: installs a signal handler before the imports, and disables garbage collection during the imports.

The first process of a container receives no signal without a handler. Without one, a container that is stopped while
its program still imports (a second or more) would run for the whole grace period, and its pod with it: a Job that ends
immediately would take half a minute.

Imported objects are never freed. Garbage collection during the imports would take a tenth of the start time, and later
collections would scan these objects again, with a pause each time.
"""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

ENDED = 128 + signal.SIGTERM
"""The exit code of a program that ends before it has started, as shells report it."""


def end_on_sigterm() -> None:
    """End at once on SIGTERM, until a handler for a graceful shutdown replaces this one."""
    signal.signal(signal.SIGTERM, _end)


@contextmanager
def importing() -> Iterator[None]:
    """Around imports: disables garbage collection, and later excludes the objects that were created within."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _end(*_: object) -> NoReturn:
    os._exit(ENDED)
