"""promtool, which tries alerts: that of the PATH, else out of Debian's package, without installing anything."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from tests.gobuild import apt_lock, cache

_PACKAGE = "prometheus"


class PromtoolUnavailableError(Exception):
    """promtool is not installed and cannot be fetched; the message gives the remedy."""


def find_promtool() -> Path:
    """The path of promtool; fetches it into the cache if it is missing. Raises PromtoolUnavailableError."""
    if (there := shutil.which("promtool")) is not None:
        return Path(there)
    cached = cache() / "promtool" / "promtool"
    with apt_lock():
        if cached.is_file():
            return cached
        cached.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cached.parent) as folder:
            _unpack(Path(folder))
            os.replace(Path(folder) / "root" / "usr" / "bin" / "promtool", cached)
    return cached


def _unpack(folder: Path) -> None:
    apt = ["apt-get", "--quiet", "-o", "Acquire::Retries=5"]
    download = [*apt, "download", _PACKAGE]
    try:
        if _run(download, folder, check=False).returncode:  # the lists of packages are missing or old
            _run([*apt, "update"], folder)
            _run(download, folder)
        (package,) = folder.glob("*.deb")
        _run(["dpkg-deb", "--extract", str(package), "root"], folder)
    except (OSError, subprocess.CalledProcessError) as error:
        why = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else error
        raise PromtoolUnavailableError(
            f"promtool is not on the PATH, and Debian's package {_PACKAGE} cannot be had ({why}): put promtool, which "
            "comes with Prometheus, on the PATH"
        ) from error


def _run(command: list[str], folder: Path, *, check: bool = True) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, check=check, capture_output=True, text=True)
