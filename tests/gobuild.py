"""Programs built from a pinned Go module into a cache outside the tree.

A program appears in the cache by an atomic rename: an interrupted build leaves no file that looks finished. The name
of a folder is a hash of all inputs of the build, so each pin has its own folder; a lock separates concurrent builds.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tests.cluster.toolchain import GoUnavailableError, find_go

STRIPPED = "-s -w"


def kubernetes(version: str) -> str:
    """The linker's flags for this version, e.g. 1.36.3.

    A plain `go build` reports v0.0.0, on which clients and CRD conversion then rely.
    """
    major, minor, _ = version.split(".")
    package = "k8s.io/component-base/version"
    values = {"gitVersion": f"v{version}", "gitMajor": major, "gitMinor": minor}
    return " ".join((STRIPPED, *(f"-X {package}.{name}={value}" for name, value in values.items())))


KUBERNETES = kubernetes("1.36.3")
OLDEST_KUBERNETES = kubernetes("1.31.0")


class BuildError(Exception):
    """A program cannot be built; the message gives the remedy."""


@dataclass(frozen=True)
class GoModule:
    """A folder with go.mod and go.sum, and the programs built from it.

    Attributes:
        name: of its part of the cache.
        source: the folder.
        packages: the Go package of each program.
        ldflags: for the linker.
    """

    name: str
    source: Path
    packages: Mapping[str, str]
    ldflags: str = STRIPPED

    @property
    def flags(self) -> tuple[str, ...]:
        """What `go build` gets."""
        return ("-trimpath", "-buildvcs=false", "-ldflags", self.ldflags)

    def folder(self, environment: Mapping[str, str] = os.environ) -> Path:
        """Return the folder of what is built from the present pins, programs of our own, flags and platform."""
        digest = hashlib.sha256()
        sources = [self.source / "go.mod", self.source / "go.sum", *sorted(self.source.glob("*.go"))]
        pins = [path.read_bytes() for path in sources if path.exists()]
        for part in (*pins, "\0".join(self.flags).encode(), f"{platform.system()}/{platform.machine()}".encode()):
            digest.update(len(part).to_bytes(8, "big") + part)
        return cache(environment) / self.name / digest.hexdigest()[:16]

    def ensure(self, console: Console, names: tuple[str, ...] = ()) -> Path:
        """Build those of `names` (default: all) that are missing; return the folder. Raises BuildError."""
        folder = self.folder()
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / ".lock"):
            missing = [name for name in names or self.packages if not (folder / name).is_file()]
            if missing:
                self._build(missing, folder, console)
        return folder

    def _build(self, names: Sequence[str], folder: Path, console: Console) -> None:
        """Build all at once: Go compiles shared packages only once, and links one while it compiles the next."""
        what = ", ".join(names)
        try:
            go = find_go(cache() / "controlplane" / "go", console)
        except GoUnavailableError as error:
            raise BuildError(f"{what} must be built, which needs Go: {error}") from error
        environment = os.environ | {"CGO_ENABLED": "0", "GOTOOLCHAIN": "local", "GOWORK": "off"}
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as unfinished:
            # A program has the name of its package's folder, so those that want another name are built one by one.
            together = [name for name in names if self.packages[name].rpartition("/")[2] == name]
            commands = [[f"{unfinished}/", *(self.packages[name] for name in together)]] if together else []
            commands += [[f"{unfinished}/{name}", self.packages[name]] for name in names if name not in together]
            with _progress(f"building {what} (once, for minutes)", console):
                for command in commands:
                    done = subprocess.run(
                        [str(go), "build", *self.flags, "-o", *command],
                        cwd=self.source,
                        env=environment,
                        stdout=subprocess.PIPE,
                        stderr=subprocess.STDOUT,
                        text=True,
                        check=False,
                    )
                    if done.returncode != 0:
                        raise BuildError(
                            f"building {what} failed (exit code {done.returncode}; needs the Go module proxy or a "
                            "filled module cache, about 2 GB of memory and 4 GB of disk):\n"
                            f"{done.stdout.strip()[-4000:]}"
                        )
            for name in names:
                (Path(unfinished) / name).rename(folder / name)
        console.print(f"built {what} in {time.monotonic() - began:.0f} s", highlight=False)


def cache(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of all that tests build once: `${XDG_CACHE_HOME:-~/.cache}/wayside`."""
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wayside"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a folder against other builds."""
    with path.open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def apt_lock() -> AbstractContextManager[None]:
    """Keep two runs of apt-get of ours apart: the lists of packages have a lock that apt-get does not wait for."""
    cache().mkdir(parents=True, exist_ok=True)
    return locked(cache() / ".apt")


@contextmanager
def _progress(what: str, console: Console) -> Iterator[None]:
    """Show a spinner with the seconds so far on a terminal; a pipe gets one line at the start."""
    if not console.is_terminal:
        console.print(what, highlight=False)
        yield
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        progress.add_task(what, total=None)
        yield
