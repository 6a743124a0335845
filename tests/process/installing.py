"""Installing the package of an example, as a user would."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path


def installed(example: Path, folder: Path) -> Path:
    """Install the example's package below the folder; return the folder of its modules."""
    source, target = folder / "source", folder / "target"
    shutil.copytree(example, source)  # the build writes files beside the sources
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, "--target", target, source], check=True)
    return target
