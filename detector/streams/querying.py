"""Queries running detectors over Zenoh; the counterpart of `answering`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import zenoh

from detector.streams.answering import status_key
from detector.streams.session import NetworkError, open_session
from wayside.api.zenoh import Zenoh
from wayside.inputerror import InputError

_PATIENCE = 0.2
"""Seconds between two attempts to find a detector."""


class NoAnswerError(InputError, ValueError):
    """There was no response, or it was a refusal; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class Reply:
    """One detector's response, as JSON."""

    key: str
    payload: bytes

    @property
    def holder(self) -> str:
        """The detector that responded."""
        return self.key.split("/")[2]


def query_detectors(
    config: Zenoh,
    holder: str,
    what: str,
    given: Mapping[str, str],
    timeout: float,
    payload: bytes | None = None,
    complete: Callable[[Sequence[Reply]], bool] = bool,
) -> list[Reply]:
    """The responses of all detectors with that name (`*`: with any), within `timeout` seconds.

    The query is repeated until the responses are `complete`, by default until there is one. At the timeout, those of
    the last query are returned.

    Raises:
        NetworkError: no session.
        NoAnswerError: there was no response, or every response was a refusal.
    """
    selector = status_key(holder, what) + "".join(
        f"{'?' if number == 0 else ';'}{name}={value}" for number, (name, value) in enumerate(given.items())
    )
    end = time.monotonic() + timeout
    with open_session(config) as session:
        while True:
            answers: list[Reply] = []
            refusals: list[str] = []
            left = max(0.1, end - time.monotonic())
            for reply in session.get(selector, payload=payload, timeout=left, target=zenoh.QueryTarget.ALL):
                if (ok := reply.ok) is not None:
                    answers.append(Reply(str(ok.key_expr), ok.payload.to_bytes()))
                elif (error := reply.err) is not None:
                    refusals.append(error.payload.to_string())
            last = time.monotonic() + _PATIENCE >= end
            if complete(answers) or (answers and last):
                return sorted(answers, key=lambda answer: answer.key)
            if not answers and any("Timeout" not in text for text in refusals):
                raise NoAnswerError("; ".join(sorted({text for text in refusals if "Timeout" not in text})))
            # A peer has just connected, and may not know the queryables yet.
            if last:
                where = ", ".join(config.connect) or "the local network"
                raise NoAnswerError(
                    f"no response from detector {holder} at {where} within {timeout:g} s: is it running, "
                    "and is this its Zenoh network? Give --connect ENDPOINT, e.g. tcp/127.0.0.1:7447"
                )
            time.sleep(_PATIENCE)


__all__ = ["NetworkError", "NoAnswerError", "Reply", "query_detectors"]
