"""Waits for a condition and reports the last state on a timeout."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import TypeVar

from tests.patience import PATIENCE

State = TypeVar("State")

INTERVAL = 0.05  # s between two reads: short compared with typical waits, long compared with one request


def wait_until(
    read: Callable[[], State],
    holds: Callable[[State], bool],
    *,
    timeout: float = PATIENCE,
    what: str,
    transient: tuple[type[Exception], ...] = (),
    diagnose: Callable[[], str] | None = None,
) -> State:
    """Read the state repeatedly until `holds` is true; return that state.

    Args:
        read: returns the current state.
        holds: whether the wait is over.
        timeout: seconds.
        what: the awaited condition, for the message ("the Deployment is available").
        transient: errors of `read` that mean "not yet", e.g. while the API server is unavailable.
        diagnose: more text for the message, e.g. the end of a log.

    Raises:
        TimeoutError: with `what` and the last state or error seen.
    """
    deadline = time.monotonic() + timeout
    last = "(never read)"
    while True:
        try:
            state = read()
            if holds(state):
                return state
            last = _shown(state)
        except transient as error:
            last = f"{type(error).__name__}: {error}"
        if time.monotonic() >= deadline:
            more = f"\n{diagnose()}" if diagnose else ""
            raise TimeoutError(f"after {timeout:g} s still not: {what}. Last seen:\n{last}{more}")
        time.sleep(INTERVAL)


def _shown(state: object) -> str:
    try:
        text = json.dumps(state, indent=1, ensure_ascii=False)
    except TypeError:
        text = repr(state)
    return text if len(text) < 6000 else f"{text[:4000]}\n… ({len(text)} characters) …\n{text[-2000:]}"
