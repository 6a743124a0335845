"""`make image`: builds the Dockerfile with buildah, on machines without Docker, and prints the compressed size.

Needs root, buildah and debootstrap. It makes a base in place of the Dockerfile's: a Debian 13 with its Python, from
Debian's packages, with the certificate authorities of this machine. Ends with 1 where the default image exceeds its
limit.

    python docker/image.py [--variant default|full] [--base IMAGE] [--keep OCI-FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from wheels import IMAGES, LIMIT

ROOT = Path(__file__).parents[1]
SUITE, MIRROR = "trixie", "http://deb.debian.org/debian"
INCLUDED = "python3,python3-venv,python3-pip,ca-certificates"
BASE_IMAGE, IMAGE = "localhost/base:1", "localhost/wayside:1"
LEFT_OUT = ("usr/share/doc", "usr/share/man", "usr/share/locale", "var/cache/apt", "var/lib/apt/lists")
AUTHORITIES = Path("etc/ssl/certs/ca-certificates.crt")


class Builder:
    """buildah with a storage of its own, which needs no overlay file system."""

    def __init__(self, folder: Path) -> None:
        self._command = ["buildah", "--root", str(folder / "storage"), "--runroot", str(folder / "run")]

    def __call__(self, *arguments: str) -> str:
        """What buildah prints. Raises subprocess.CalledProcessError."""
        environment = os.environ | {"STORAGE_DRIVER": "vfs"}
        command = [*self._command, *arguments]
        return subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True).stdout.strip()


def make_base(build: Builder, folder: Path) -> None:
    """An image of Debian and Python under the name BASE_IMAGE."""
    system = folder / "base"
    command = ["debootstrap", "--variant=minbase", f"--include={INCLUDED}", SUITE, str(system), MIRROR]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    for each in LEFT_OUT:
        shutil.rmtree(system / each)
    shutil.copy("/" / AUTHORITIES, system / AUTHORITIES)
    (system / "etc/pip.conf").write_text(f"[global]\ncert = /{AUTHORITIES}\n")  # pip brings authorities of its own
    container = build("from", "scratch")
    build("add", "--quiet", container, str(system), "/")
    build("config", "--env", "PATH=/usr/local/bin:/usr/bin:/bin", container)
    build("commit", "--quiet", "--rm", container, BASE_IMAGE)


def layers(image: Path) -> list[float]:
    """MB of each layer of an image in an OCI folder, compressed, the base first."""

    def blob(digest: str) -> dict[str, list[dict[str, str]]]:
        found: dict[str, list[dict[str, str]]] = json.loads((image / "blobs" / digest.replace(":", "/")).read_text())
        return found

    index = json.loads((image / "index.json").read_text())
    return [int(each["size"]) / 1e6 for each in blob(index["manifests"][0]["digest"])["layers"]]


def main() -> int:
    """Build and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--variant", choices=sorted(IMAGES), default="default", help="(%(default)s)")
    parser.add_argument("--base", help="an image that buildah can pull; default: made of Debian's packages")
    parser.add_argument("--keep", type=Path, metavar="OCI-FOLDER", help="keep the image in this folder")
    options = parser.parse_args()
    missing = [each for each in ("buildah", *([] if options.base else ["debootstrap"])) if shutil.which(each) is None]
    if missing or os.geteuid() != 0:
        print(f"needs root{''.join(f', {each}' for each in missing)}: install what is missing, run it as root")
        return 2
    with tempfile.TemporaryDirectory(prefix="wayside-image-") as temporary:
        folder = Path(temporary)
        build = Builder(folder)
        if options.base is None:
            make_base(build, folder)
        given = (f"BASE={options.base or BASE_IMAGE}", f"REQUIREMENTS={IMAGES[options.variant].name}")
        words = [word for each in given for word in ("--build-arg", each)]
        # A chroot needs no privileges of the kernel that a container may lack.
        build("bud", "--isolation", "chroot", "--timestamp", "0", *words, "--tag", IMAGE, str(ROOT))
        kept = options.keep or folder / "image"
        build("push", "--quiet", IMAGE, f"oci:{kept}:{options.variant}")
        for program in ("detector", "application-manager"):
            container = build("from", IMAGE)
            build("run", "--isolation", "chroot", container, "--", program, "--help")
        sizes = layers(kept)
        ratio = sum(sizes) / sizes[0]
        print(
            f"{options.variant}: {sum(sizes):.0f} MB compressed, {ratio:.1f} times its base of {sizes[0]:.0f} MB; "
            "both programs start"
        )
        if options.variant == "default" and sum(sizes) > LIMIT:
            print(f"more than the limit of {LIMIT:.0f} MB")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
