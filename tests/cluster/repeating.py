"""Repeats a call in a thread beside a test, for the duration of a `with` block."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeated(name: str, do: Callable[[], None], interval: float) -> Iterator[None]:
    """Call `do` in a thread of this name, with `interval` seconds between two calls, and once more after the block.

    Raises:
        Exception: what `do` raised, at the end of the block, unless the block itself raised.
    """
    ended = threading.Event()
    failures: list[Exception] = []

    def run() -> None:
        try:
            while True:
                last = ended.is_set()  # checked first, so that the last call comes after the end of the block
                do()
                if last:
                    return
                ended.wait(interval)
        except Exception as error:  # noqa: BLE001  raised at the end of the block
            failures.append(error)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    if failures:
        raise failures[0]
