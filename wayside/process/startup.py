"""Process start: installs a signal handler before the imports, and defers garbage collection while they run.

The first process of a container receives no signal without a handler. Without one, a container that is stopped while
its program still imports (a second or more) would run for the whole grace period, and its pod with it: a Job that ends
immediately would take half a minute.

Imported objects are never freed. Collecting garbage during the imports costs a tenth of the start, and later a pause of
a long-lived process each time.
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
    """End at once on SIGTERM, until a handler that ends in good order takes the place of this one."""
    signal.signal(signal.SIGTERM, _end)


@contextmanager
def importing() -> Iterator[None]:
    """Around imports: within, no garbage is looked for; afterwards not in what was made within."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _end(*_: object) -> NoReturn:
    os._exit(ENDED)
