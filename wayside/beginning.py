"""What our programs do before and while they import: become able to end, and put off looking for garbage.

The first process of a container is spared every signal that it has no handler for. Without one, a container that is to
end while its program still imports (a second and more) would go on for the whole grace period, and with it its pod: a
Job that is over at once would take half a minute.

What is imported stays for good. To look for garbage in it meanwhile costs a tenth of the start, and later on a pause of
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
"""The exit code of a program that ends before it has begun, as a shell tells it."""


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
