"""How large the code base is, and how hard to find one's way in: the working tree beside an older revision.

    python -m benchmarks.structure [REVISION]

For each program and the package that they share:

- lines and modules of Python, and the longest module;
- small modules: under 30 lines, imported by exactly one other module;
- loose modules: directly in the top folder, beside the folders;
- floors: levels of the layers contract in pyproject.toml;
- names: public classes and functions that are defined in two or more modules, over all packages;
- retries: loops that catch an error and sleep or wait before the next round, written by hand.
"""

from __future__ import annotations

import argparse
import ast
import io
import subprocess
import tarfile
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGES = ("wayside", "detector", "application_manager")
SMALL = 30
_PAUSES = frozenset({"sleep", "wait", "wait_for", "pause"})


class Module:
    """One module of a package."""

    def __init__(self, root: Path, path: Path) -> None:
        self.name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        self.is_package = path.name == "__init__.py"
        text = path.read_text(encoding="utf-8")
        self.lines = text.count("\n")
        self.tree = ast.parse(text)

    def imports(self) -> Iterator[str]:
        """The names of what it imports: modules, and members of modules."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from (each.name for each in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                yield node.module
                yield from (f"{node.module}.{each.name}" for each in node.names)

    def public(self) -> Iterator[str]:
        """The public classes and functions that it defines."""
        for node in self.tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.name[0] != "_":
                yield node.name

    def retries(self) -> int:
        """How many loops catch an error and pause."""
        return sum(
            any(isinstance(each, ast.ExceptHandler) for each in ast.walk(loop))
            and any(isinstance(each, ast.Call) and _called(each) in _PAUSES for each in ast.walk(loop))
            for loop in ast.walk(self.tree)
            if isinstance(loop, ast.While | ast.For | ast.AsyncFor)
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="structure", description=__doc__)
    parser.add_argument("revision", nargs="?", default="HEAD", help="to compare with (%(default)s)")
    options = parser.parse_args()
    root = Path(__file__).parents[1]
    with tempfile.TemporaryDirectory() as folder:
        command = ["git", "-C", str(root), "archive", options.revision, *PACKAGES, "pyproject.toml"]
        archive = subprocess.run(command, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        before, after = counted(Path(folder)), counted(root)
    print(f"{'':44}{options.revision[:12]:>12}{'now':>12}")
    for name in after:
        print(f"{name:44}{before.get(name, 0):>12,}{after[name]:>12,}")


def counted(root: Path) -> dict[str, int]:
    """The figures of a tree, by what they count."""
    found: dict[str, int] = {}
    every: list[Module] = []
    layers = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    for package in PACKAGES:
        modules = [Module(root, path) for path in sorted((root / package).rglob("*.py"))]
        every += modules
        found[f"{package}: lines"] = sum(each.lines for each in modules)
        found[f"{package}: modules"] = len(modules)
        found[f"{package}: longest module, lines"] = max(each.lines for each in modules)
        found[f"{package}: loose modules"] = sum(each.name.count(".") == 1 and not each.is_package for each in modules)
        own = [each for each in layers if each.get("layers", [""])[0].startswith(f"{package}.")]
        found[f"{package}: floors"] = max((len(each["layers"]) for each in own), default=0)
    importers: Counter[str] = Counter(name for each in every for name in set(each.imports()))
    found["small modules with one importer"] = sum(
        each.lines < SMALL and not each.is_package and importers[each.name] == 1 for each in every
    )
    names = Counter(name for each in every for name in each.public())
    found["public names defined twice or more"] = sum(count > 1 for count in names.values())
    found["retries written by hand"] = sum(each.retries() for each in every)
    return found


def _called(call: ast.Call) -> str:
    """The last part of the name of what is called."""
    match call.func:
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name
        case _:
            return ""


if __name__ == "__main__":
    main()
