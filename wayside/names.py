"""Names inside keys and object names: percent-encoded, and joined so that no two subjects have the same text.

The module also suggests the known name that is most similar to a misspelt one.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from urllib.parse import unquote_to_bytes

FLEET = "~fleet"
"""The subject of a rule over the whole fleet."""

_OUTSIDE = re.compile(rb"[^A-Za-z0-9_.-]")
_all_inside = re.compile(r"[A-Za-z0-9_.-]*").fullmatch


def encode(text: str) -> str:
    """The text as one chunk of a key: every byte (UTF-8) outside `[A-Za-z0-9_.-]` becomes `%XX`."""
    if _all_inside(text):  # most names are
        return text
    return _OUTSIDE.sub(lambda found: b"%%%02X" % found[0][0], text.encode()).decode("ascii")


def decode(text: str) -> str:
    """The inverse of `encode`. Raises ValueError if the bytes are not UTF-8."""
    return unquote_to_bytes(text).decode()


def subject_text(clients: Sequence[str], element: str | None = None) -> str:
    """A subject as one word: `car1`, `car1+car2`, or `~fleet` for no client; an element of `each` follows after `~`.

    `+` and `~` never occur in an encoded name, so different subjects have different texts.
    """
    text = "+".join(map(encode, clients)) if clients else FLEET
    return text if element is None else f"{text}~{encode(element)}"


def parse_subject(text: str) -> tuple[tuple[str, ...], str | None]:
    """The clients and the element of a subject's text: the inverse of `subject_text`.

    Raises:
        ValueError: the text is not that of a subject.
    """
    is_fleet = text == FLEET or text.startswith(f"{FLEET}~")
    head, mark, tail = text.removeprefix(FLEET).partition("~")
    clients = () if is_fleet else tuple(map(decode, head.split("+")))
    element = decode(tail) if mark else None
    if subject_text(clients, element) != text or "" in clients or element == "":
        raise ValueError(
            f"the subject must be like car1, car1+car2 or {FLEET}, with ~element if the rule has each; got {text!r}"
        )
    return clients, element


def did_you_mean(name: str, known: Iterable[str], quote: str = "") -> str:
    """The remedy for an unknown name: a question with the most similar known name; empty if none is similar."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {quote}{close[0]}{quote}?" if close else ""
