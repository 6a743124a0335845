"""Undelivered events, in a file: one JSON object per line, with the reason.

The file is bounded: when it is full it is renamed to `….old.jsonl`, replacing the previous one, and a new file begins.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SIZE = 10 << 20
"""Maximum size of one file in bytes."""


class DeadLetters:
    """Appends to a file. Used by one thread at a time."""

    def __init__(self, path: Path, size: int = SIZE) -> None:
        self.path, self._size = path, size

    def write(self, letter: Mapping[str, Any]) -> None:
        """Append a letter. Raises OSError if the disk refuses, ValueError if it is not valid JSON."""
        line = json.dumps(letter, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode() + b"\n"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists() and self.path.stat().st_size + len(line) > self._size:
            os.replace(self.path, self.path.with_suffix(".old.jsonl"))
        with self.path.open("ab", buffering=0) as file:
            begun = file.tell()
            if file.write(line) != len(line):
                file.truncate(begun)  # remove a partial line
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
