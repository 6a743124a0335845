"""Rules to start from, each a short version of a use case. They read JSON of a stream `odom`; comments guide you."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files

from wayside.inputerror import InputError

STREAM = "odom"
"""The stream that drafts read."""


class DraftError(InputError, ValueError):
    """There is no such draft; the text lists the existing ones."""


def drafts() -> Mapping[str, str]:
    """The first line of each draft, its description, by use case."""
    found = sorted(each.name for each in files(__name__).iterdir() if each.name.endswith(".yaml"))
    return {name.removesuffix(".yaml"): _text(name).split("\n", 1)[0].removeprefix("# ") for name in found}


def rule_draft(case: str, stream: str, name: str | None) -> str:
    """The draft of a use case, over this stream and under this name.

    Args:
        case: the use case, as in `drafts`.
        stream: the stream's name, in place of `odom`.
        name: the rule's name; None: the use case's.

    Raises:
        DraftError: no draft has this case.
    """
    known = drafts()
    if case not in known:
        raise DraftError(f"there is no use case {case}; the use cases are {', '.join(known)}")
    text = _text(f"{case}.yaml").replace(f"stream: {STREAM}", f"stream: {stream}")
    return text if name is None else text.replace(f"metadata: {{name: {case}}}", f"metadata: {{name: {name}}}")


def _text(name: str) -> str:
    return files(__name__).joinpath(name).read_text(encoding="utf-8")
