"""`make wheels`: whether all that the images consist of is there as wheels for both architectures, and how large it is.

Downloads the wheels of each file of requirements for each architecture into a folder that is removed again. Ends with 1
where one is missing, or where the wheels of the default image exceed what its limit leaves beside the base.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ARCHITECTURES = ("x86_64", "aarch64")
LIMIT = 250.0  # MB, of the default image, compressed
BASE = 50.0  # MB, of the base image, compressed: Debian and Python are some 45
IMAGES = {"default": HERE / "requirements.txt", "full": HERE / "requirements-full.txt"}
_GLIBC = ("2_17", "2_28", "2_34")  # that of Debian 13 is newer than all of them
_PYTHON = "3.13"


def megabytes(requirements: Path, architecture: str) -> float:
    """Size of the wheels. Raises subprocess.CalledProcessError where one is missing."""
    platforms = [f"manylinux_{each}_{architecture}" for each in _GLIBC] + [f"manylinux2014_{architecture}"]
    with tempfile.TemporaryDirectory(prefix="wayside-wheels-") as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += ["--require-hashes", "--only-binary=:all:", "--python-version", _PYTHON, "--dest", folder]
        command += [word for each in platforms for word in ("--platform", each)]
        subprocess.run([*command, "--requirement", str(requirements)], check=True)
        return sum(each.stat().st_size for each in Path(folder).iterdir()) / 1e6


def main() -> int:
    """Print a line for each image and architecture."""
    wrong = 0
    for image, requirements in IMAGES.items():
        for architecture in ARCHITECTURES:
            try:
                size = megabytes(requirements, architecture)
            except subprocess.CalledProcessError:
                print(f"{image} {architecture}: not all wheels are there, see above")
                wrong = 1
                continue
            print(f"{image} {architecture}: wheels of {size:.0f} MB")
            if image == "default" and size > LIMIT - BASE:
                print(
                    f"{image} {architecture}: more than the {LIMIT - BASE:.0f} MB that its limit leaves beside the base"
                )
                wrong = 1
    return wrong


if __name__ == "__main__":
    sys.exit(main())
