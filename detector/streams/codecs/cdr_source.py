"""CDR: generates source piece by piece, and tracks its position in the message.

After a text or a sequence the position is only known when the code runs. Even then its remainder is often known, so
that an alignment needs no code. Numbers between two such places are read together.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

_MOST_LOOPS = 10
"""Maximum number of nested loops: Python bounds them."""


class UnwalkableError(ValueError):
    """No function can be generated for this type."""


@dataclass
class CdrSource:
    """Lines that read a payload `p`; the position is `base + constant`, where `base` is a variable."""

    sign: str
    """The sign of the byte order in struct and numpy."""
    noting: bool = False
    """Whether the lines also add the places of all lengths and texts to the lists `lengths` and `spans`."""
    modulus: int = 8
    remainder: int = 0
    """Of the distance to the end of the encapsulation, divided by the modulus."""
    base: str = ""
    constant: int = 0

    mark: str = ""
    """The name of the byte order's number."""
    lines: list[str] = field(default_factory=list)
    bound: dict[str, Any] = field(default_factory=dict)
    """The objects that the lines refer to."""
    names: int = 0
    indent: str = ""
    pending: list[tuple[int, str, str]] = field(default_factory=list)
    """Pending numbers, to be read together: constant, format and name."""

    def at(self, further: int = 0) -> str:
        """The position as source."""
        constant = self.constant + further
        return str(constant) if not self.base else f"{self.base} + {constant}" if constant else self.base

    def encapsulation(self) -> None:
        """Reads the byte order."""
        self.mark = self.read("H", 2)
        self.constant, self.remainder = 4, 0

    def wrong(self, mark: int) -> str:
        """After the last field: whether the payload has another byte order than `mark`, or does not end here."""
        return f"{self.mark} != {mark} or not {self.at()} <= len(p) <= {self.at(3)}"

    def name(self) -> str:
        """A new variable."""
        self.names += 1
        return f"v{self.names}"

    def line(self, text: str) -> None:
        """Adds a line, after those that read the numbers before it."""
        self.flush()
        self.lines.append(self.indent + text)

    def bind(self, value: Any) -> str:
        """A name for a value in the source."""
        name = f"x{len(self.bound)}"
        self.bound[name] = value
        return name

    def read(self, form: str, size: int) -> str:
        """Reads a number; returns the name of its value."""
        name = self.name()
        self.pending.append((self.constant, form, name))
        self.advance(size)
        return name

    def length(self) -> str:
        """Reads the length of a text or sequence; returns the name of its value."""
        if self.noting:
            self.lines.append(f"{self.indent}lengths.append({self.at()})")
        return self.read("I", 4)

    def flush(self) -> None:
        """Adds the line that reads the pending numbers."""
        if not self.pending:
            return
        first = position = self.pending[0][0]
        form = self.sign
        for constant, part, _ in self.pending:
            form += f"{constant - position}x{part}" if constant > position else part
            position = constant + struct.calcsize(self.sign + part)
        names = ", ".join(name for _, _, name in self.pending)
        self.pending.clear()
        unpack = self.bind(struct.Struct(form).unpack_from)
        here = str(first) if not self.base else f"{self.base} + {first}" if first else self.base
        self.lines.append(f"{self.indent}{names}, = {unpack}(p, {here})")

    def advance(self, size: int) -> None:
        """Advance by a number of bytes."""
        self.constant += size
        self.remainder = (self.remainder + size) % self.modulus

    def rebase(self, source: str, modulus: int, constant: int = 0) -> None:
        """Continue at a computed position, which is a multiple of the modulus from the end of the encapsulation."""
        name = self.name()
        self.line(f"{name} = {source}")
        self.base, self.constant, self.modulus, self.remainder = name, constant, modulus, 0

    def divisor(self) -> int:
        """The largest power of two, up to 8, that is known to divide the distance to the end of the encapsulation."""
        return math.gcd(self.modulus, self.remainder)

    def align(self, size: int) -> None:
        """Advance to the next multiple of the size."""
        if self.modulus % size == 0:
            self.advance(-self.remainder % size)
        elif size == 8:  # the encapsulation has 4 bytes
            self.rebase(f"({self.at(3)}) & -8", 8, 4)
        else:
            self.rebase(f"({self.at(size - 1)}) & -{size}", size)

    def loop(self, count: str, body: Callable[[], None]) -> None:
        """Repeats the lines that `body` adds. Raises UnwalkableError."""
        if len(self.indent) >= _MOST_LOOPS:
            raise UnwalkableError("sequences are nested too deeply")
        self.rebase(self.at(), 1)
        base = self.base
        self.line(f"for _ in range({count}):")
        self.indent += " "
        body()
        self.line(f"{base} = {self.at()}")
        self.indent = self.indent[:-1]
        self.base, self.constant, self.modulus, self.remainder = base, 0, 1, 0
