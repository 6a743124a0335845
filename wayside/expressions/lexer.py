"""CEL's tokens with their positions in the text, for the number pass and the `${…}` scanner.

The lexer never fails: a text that is not a token of CEL becomes `OTHER`, and CEL's parser reports it later.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Iterator
from dataclasses import dataclass


class TokenKind(enum.Enum):
    """The kinds of token that callers distinguish."""

    SPACE = "space"
    COMMENT = "comment"
    STRING = "string"
    FLOAT = "float"
    UINT = "uint"
    INT = "int"
    NAME = "name"
    OPEN = "open"
    CLOSE = "close"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class Token:
    """A part of the text: `text` begins at the offset `start`, in characters."""

    kind: TokenKind
    text: str
    start: int

    @property
    def end(self) -> int:
        """The offset after the last character."""
        return self.start + len(self.text)


# Order matters: raw strings before plain ones before names, triple quotes before single, floats before integers.
# Of an unterminated string, only the quote is OTHER, so scanning continues after it.
_TOKENS = re.compile(
    r"""
    (?P<space>\s+)
  | (?P<comment>//[^\n]*)
  | (?P<string>
        [bB]?[rR] (?: \"{3}.*?\"{3} | '{3}.*?'{3} | "[^"\r\n]*" | '[^'\r\n]*' )
      | [bB]?     (?: \"{3}(?:\\.|[^\\])*?\"{3} | '{3}(?:\\.|[^\\])*?'{3}
                    | "(?:\\.|[^\\"\r\n])*" | '(?:\\.|[^\\'\r\n])*' )
    )
  | (?P<float>[0-9]+\.[0-9]+(?:[eE][+-]?[0-9]+)? | [0-9]+[eE][+-]?[0-9]+ | \.[0-9]+(?:[eE][+-]?[0-9]+)?)
  | (?P<uint>(?:0x[0-9a-fA-F]+|[0-9]+)[uU])
  | (?P<int>0x[0-9a-fA-F]+|[0-9]+)
  | (?P<name>[A-Za-z_][A-Za-z0-9_]*|`[^`\n]*`)
  | (?P<open>[(\[{])
  | (?P<close>[)\]}])
  | (?P<other>&&|\|\||[=!<>]=|.)
    """,
    re.VERBOSE | re.DOTALL,
)


def tokens(text: str, start: int = 0) -> Iterator[Token]:
    """The tokens of `text` from `start`, including spaces and comments: joined, they are the text."""
    for match in _TOKENS.finditer(text, start):
        kind = match.lastgroup
        assert kind is not None  # noqa: S101 (every alternative is a named group)
        yield Token(TokenKind(kind), match.group(), match.start())
