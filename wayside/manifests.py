"""Objects as YAML text that all Kubernetes tools read in the same way."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import yaml

_READ_AS_BOOLEANS = re.compile(r"[yYnN]")
"""Scalars that kubectl's YAML reads as booleans. PyYAML does not, and would write them without quotes."""


class _Dumper(yaml.SafeDumper):
    """Writes a lone y or n in quotes, and no anchors, which people do not expect."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    quoted = "'" if _READ_AS_BOOLEANS.fullmatch(value) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=quoted)


_Dumper.add_representer(str, _text)


def to_yaml(objects: Iterable[Any]) -> str:
    """The objects as YAML documents, with their fields in the given order; empty for no objects."""
    return "---\n".join(
        yaml.dump(each, Dumper=_Dumper, sort_keys=False, width=120, allow_unicode=True) for each in objects
    )
