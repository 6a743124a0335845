"""JSON lines: one message a line, `{"t": <ns>, "key": "vehicles/car7/pose", "value": {…}}`, in the order of `t`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from detector.replay.errors import RecordingError
from detector.replay.message import Cut, Message, OnCut, Wanted, key_of

EXAMPLE = '{"t": 1700000000000000000, "key": "vehicles/car7/pose", "value": {"x": 1.5}}'


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    t: int
    key: str
    value: msgspec.Raw


_read = msgspec.json.Decoder(_Line).decode


def read_json_lines(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Message]:
    """The lines' messages; their values stay the text that they are. Empty lines are passed over.

    A last line that was not written to its end is a cut. Raises RecordingError, with file and line, for what is no
    such line and where `t` goes back.
    """
    last = messages = 0
    with path.open("rb") as file:
        for number, text in enumerate(file, start=1):
            if text.isspace():
                continue
            try:
                line = _read(text)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                if not text.endswith(b"\n"):
                    on_cut(Cut(path, messages, f"line {number} has no end"))
                    return
                raise RecordingError(f"{path}:{number}: {error}: a line reads {EXAMPLE}") from error
            key = key_of(line.key)
            if line.t < last:
                problem = "t is negative" if line.t < 0 else f"t goes back from {last} to {line.t}: sort the lines by t"
                raise RecordingError(f"{path}:{number}: {problem}")
            if not key:
                raise RecordingError(f"{path}:{number}: key is empty: a line reads {EXAMPLE}")
            last = line.t
            if wanted(key):
                messages += 1
                yield Message(line.t, key, bytes(line.value), "json", None)
