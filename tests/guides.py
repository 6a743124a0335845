"""The guides in docs/ and their examples."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
"""Of the tree."""


def guide(name: str) -> str:
    """The text of docs/<name>.md."""
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def yaml_blocks(text: str) -> list[str]:
    """The contents of the text's fenced YAML blocks."""
    return re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
