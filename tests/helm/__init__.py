"""Helm and an OCI registry, built from pinned source into a cache outside the tree.

`python -m tests.helm` builds what is missing, in `${XDG_CACHE_HOME:-~/.cache}/wayside/helm/<hash>/`: about four minutes
of one core, once. The hash covers all inputs of the build, as for the control plane.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tests.gobuild import BuildError, GoModule

PACKAGES: Mapping[str, str] = {
    "registry": "github.com/google/go-containerregistry/cmd/registry",
    "helm": "helm.sh/helm/v4/cmd/helm",
}
MODULE = GoModule("helm", Path(__file__).parent / "module", PACKAGES)


class ToolsUnavailableError(Exception):
    """Helm or the registry cannot be built; the message gives the remedy."""


@dataclass(frozen=True)
class Tools:
    """The path of each program."""

    helm: Path
    registry: Path


def ensure_tools(console: Console | None = None) -> Tools:
    """The programs, built if they are not in the cache. Raises ToolsUnavailableError."""
    try:
        folder = MODULE.ensure(console or Console(stderr=True))
    except BuildError as error:
        raise ToolsUnavailableError(str(error)) from error
    return Tools(folder / "helm", folder / "registry")


def main() -> int:
    """Build what is missing."""
    try:
        print(ensure_tools().helm.parent)
    except ToolsUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
