"""Helm and an OCI registry, built from pinned source into a cache outside the tree.

`python -m tests.helm` builds what is missing, in `${XDG_CACHE_HOME:-~/.cache}/wayside/helm/<hash>/`: about four minutes
of one core, once. The hash covers all that decides what comes out, as for the control plane.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tests.cluster.binaries import locked
from tests.cluster.toolchain import GoUnavailableError, find_go

MODULE = Path(__file__).parent / "module"
PACKAGES: Mapping[str, str] = {
    "registry": "github.com/google/go-containerregistry/cmd/registry",
    "helm": "helm.sh/helm/v4/cmd/helm",
}
BUILD_FLAGS = ("-trimpath", "-buildvcs=false", "-ldflags", "-s -w")


class ToolsUnavailableError(Exception):
    """Helm or the registry cannot be built; the message says what to do."""


@dataclass(frozen=True)
class Tools:
    """Where each program is."""

    helm: Path
    registry: Path


def ensure_tools(console: Console | None = None) -> Tools:
    """The programs, built if they are not in the cache. Raises ToolsUnavailableError."""
    console = console or Console(stderr=True)
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / ".lock"):
        for name in PACKAGES:
            if not (folder / name).is_file():
                _build(name, folder, console)
    return Tools(folder / "helm", folder / "registry")


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """The folder of the programs that are built from the present pins, flags and platform."""
    digest = hashlib.sha256()
    for part in (
        *((MODULE / name).read_bytes() for name in ("go.mod", "go.sum")),
        "\0".join(BUILD_FLAGS).encode(),
        f"{platform.system()}/{platform.machine()}".encode(),
    ):
        digest.update(len(part).to_bytes(8, "big") + part)
    base = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "wayside" / "helm" / digest.hexdigest()[:16]


def _build(name: str, folder: Path, console: Console) -> None:
    try:
        go = find_go(folder.parent.parent / "controlplane" / "go", console)
    except GoUnavailableError as error:
        raise ToolsUnavailableError(f"{name} has to be built, which needs Go: {error}") from error
    unfinished = folder / f".{name}.{os.getpid()}"
    console.print(f"building {name} (once; helm takes minutes)", highlight=False)
    began = time.monotonic()
    environment = os.environ | {"CGO_ENABLED": "0", "GOTOOLCHAIN": "local", "GOWORK": "off"}
    command = [str(go), "build", *BUILD_FLAGS, "-o", str(unfinished), PACKAGES[name]]
    try:
        done = subprocess.run(command, cwd=MODULE, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ToolsUnavailableError(
                f"building {name} failed (it needs the Go module proxy or a filled module cache):\n"
                f"{(done.stdout + done.stderr)[-4000:]}"
            )
        unfinished.rename(folder / name)
    finally:
        unfinished.unlink(missing_ok=True)
    console.print(f"built {name} in {time.monotonic() - began:.0f} s", highlight=False)


def main() -> int:
    """Build what is missing."""
    try:
        print(ensure_tools().helm.parent)
    except ToolsUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
