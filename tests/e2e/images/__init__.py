"""The images of the tests, made on machines that reach no image registry: Debian's packages and our wheel.

The image of this project has three layers: a root from debootstrap (cached by its inputs), the packages that
the project depends on (cached by their pins), and the project. It has the content of the Dockerfile's: both programs,
an unprivileged user, an entrypoint without a shell. All is compiled: a container's root is read-only, so
otherwise each start would compile again.
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from tests.e2e.images.oci import Image, Layer, write_archive, write_layer
from tests.gobuild import cache, locked

ROOT = Path(__file__).parents[3]
SANDBOX_IMAGE = "wayside.test/pause:1"
WAYSIDE_IMAGE = "wayside.test/wayside:1"
SUITE, PYTHON = "bookworm", "3.11"  # the Python version of this Debian suite
MIRROR = "http://deb.debian.org/debian"
INCLUDED = "python3,ca-certificates"
LIBRARIES = f"usr/local/lib/python{PYTHON}/dist-packages"
LEFT_OUT = ("usr/share/doc", "usr/share/man", "usr/share/locale", "usr/share/info", "var/cache", "var/lib/apt/lists",
            "var/log", "dev", "proc", "sys", "run", "tmp")  # fmt: skip
KEPT_DEFINITIONS = ("__init__", "ITS")
"""The ASN.1 modules of pycrate to keep: ITS messages. All others, mostly of mobile networks, are 140 MB."""
NOBODY = "65532:65532"
STUB = """\
#!/usr/bin/python3
import sys
from {module} import main
sys.exit(main())
"""


class ImageError(Exception):
    """An image cannot be built; the message gives the remedy."""


def pause_archive(program: Path, folder: Path) -> Path:
    """Write the image of a pod's sandbox, which contains only `program`; return the archive."""
    layer = write_layer(folder / "pause-layer.tar", [(program, "pause")])
    write_archive(archive := folder / "pause.tar", Image(SANDBOX_IMAGE, [layer], {"Entrypoint": ["/pause"]}))
    return archive


def wayside_archive(folder: Path, console: Console | None = None) -> Path:
    """Write the image of the current tree, named WAYSIDE_IMAGE; return the archive. Raises ImageError."""
    console = console or Console(stderr=True)
    base, libraries = lasting_layers(console)
    with tempfile.TemporaryDirectory(prefix="wayside-wheel-") as work:
        wheel = build_wheel(Path(work))
        layers = [base, libraries, _project_layer(wheel, Path(work), folder, base)]
    config = {
        "Env": ["PATH=/usr/local/bin:/usr/bin:/bin", "HOME=/tmp", "PYTHONUNBUFFERED=1", "PYTHONDONTWRITEBYTECODE=1"],
        "User": NOBODY,
        "WorkingDir": "/",
        "Labels": {"org.opencontainers.image.title": "wayside"},
    }
    write_archive(archive := folder / "wayside.tar", Image(WAYSIDE_IMAGE, layers, config))
    return archive


def build_wheel(folder: Path) -> Path:
    """Build the project's wheel from a copy, so that nothing is left in the tree; return its path."""
    source = folder / "source"
    source.mkdir()
    for name in ("wayside", "detector", "application_manager"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    _run([sys.executable, "-m", "pip", "wheel", *options, str(source)])
    (wheel,) = folder.glob("wayside-*.whl")
    return wheel


def lasting_layers(console: Console) -> tuple[Layer, Layer]:
    """The layers that do not change with the project, from the cache or built. Raises ImageError."""
    base = _base_layer(console)
    return base, _libraries_layer(console, base)


def _base_layer(console: Console) -> Layer:
    def make(path: Path) -> Layer:
        console.print(f"making the root of the images with debootstrap ({SUITE}, once; a minute or two)")
        with tempfile.TemporaryDirectory(prefix="wayside-root-") as work:
            root = Path(work) / "root"
            options = ["--variant=minbase", f"--include={INCLUDED}"]
            _run(["/usr/sbin/debootstrap", *options, SUITE, str(root), MIRROR])
            for name in LEFT_OUT:
                (root / name).mkdir(exist_ok=True, parents=True)
            _compile(root, f"/usr/lib/python{PYTHON}")
            return write_layer(path, [(root, "")], lambda place: place.startswith(tuple(f"{e}/" for e in LEFT_OUT)))

    return _cached("base", f"{SUITE} {INCLUDED} {LEFT_OUT} 3", make)


def _libraries_layer(console: Console, base: Layer) -> Layer:
    pins = ROOT / "docker" / "requirements.txt"

    def make(path: Path) -> Layer:
        console.print("installing the packages of docker/requirements.txt for the image (once for each version of it)")
        with tempfile.TemporaryDirectory(prefix="wayside-libraries-") as work:
            target = Path(work) / "target"
            glibcs = [f"--platform=manylinux_2_{minor}_{_machine()}" for minor in range(36, 16, -1)]
            where = [*glibcs, f"--platform=manylinux2014_{_machine()}", f"--python-version={PYTHON}"]
            options = ["--quiet", "--target", str(target), "--only-binary=:all:", "--implementation=cp", *where]
            _run(
                [sys.executable, "-m", "pip", "install", *options, "--no-compile", "--require-hashes", "-r", str(pins)]
            )
            for left in (target / "bin", *target.glob("setuptools*")):
                shutil.rmtree(left)
            for definitions in (target / "pycrate_asn1dir").glob("*.py"):
                if not definitions.name.startswith(KEPT_DEFINITIONS):
                    definitions.unlink()
            with _within(base, target) as compiled:
                return write_layer(path, [(compiled, LIBRARIES)], _superfluous)

    return _cached("libraries", f"{PYTHON} {base.digest} {KEPT_DEFINITIONS} {pins.read_text()}", make)


def _project_layer(wheel: Path, work: Path, folder: Path, base: Layer) -> Layer:
    target = work / "project"
    _run(
        [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--no-compile",
            "--no-deps",
            "--target",
            str(target),
            str(wheel),
        ]
    )
    shutil.rmtree(target / "bin")
    sources = []
    for name, module in (
        ("detector", "detector.commands.program"),
        ("application-manager", "application_manager.program"),
    ):
        stub = work / name
        stub.write_text(STUB.format(module=module))
        stub.chmod(0o755)
        sources.append((stub, f"usr/local/bin/{name}"))
    with _within(base, target) as compiled:
        return write_layer(folder / "project-layer.tar", [(compiled, LIBRARIES), *sources], _superfluous)


@contextmanager
def _within(base: Layer, target: Path) -> Iterator[Path]:
    """Move packages into the image root and compile them there with its Python; yields their path for the block."""
    with tempfile.TemporaryDirectory(prefix="wayside-root-") as work:
        _run(["tar", "--extract", f"--file={base.path}", f"--directory={work}"])
        place = Path(work) / LIBRARIES
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(place, ignore_errors=True)
        shutil.move(target, place)
        _compile(Path(work), f"/{LIBRARIES}")
        yield place


def _compile(root: Path, folder: str) -> None:
    """Compile all files below a folder of the root. Bytecode that is not compared with its source contains no times."""
    options = ["--invalidation-mode=unchecked-hash", "-q", "-f", "-x", "/tests/|/lib2to3/tests/"]
    _run(["/usr/sbin/chroot", str(root), f"/usr/bin/python{PYTHON}", "-m", "compileall", *options, folder])


def _superfluous(place: str) -> bool:
    """Tests of packages are never imported, nor are types that only editors read."""
    return place.endswith("/tests") or place.endswith(".pyi")


def _cached(name: str, made_of: str, make: Callable[[Path], Layer]) -> Layer:
    """Return a layer from the cache, or build it."""
    folder = cache() / "images"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{hashlib.sha256(f'{made_of} {_machine()}'.encode()).hexdigest()[:16]}.tar"
    with locked(folder / ".lock"):
        return Layer.of(path) if path.exists() else make(path)


def _machine() -> str:
    return platform.machine()


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        output = (done.stdout + done.stderr).strip()[-3000:]
        raise ImageError(f"`{' '.join(command)}` failed (exit code {done.returncode}):\n{output}")
