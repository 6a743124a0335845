"""How large the code base is, and how hard to find one's way in: the working tree beside an older revision.

    python -m benchmarks.structure [REVISION]

For each program and the package that they share, into which much of both has moved, and for all together:

- lines and modules of Python, and the longest module;
- lines and modules without later features: without the folders of `LATER`, which came with other work;
- small modules: under 30 lines, imported by exactly one other module;
- loose modules: directly in the top folder, beside the folders;
- floors: levels of the layers contract in pyproject.toml;
- names: public classes and functions that are defined in two or more modules, over all packages;
- retries: loops that try again after an error, written by hand. Such a loop has an `except` that does not leave it, and
  a pause of some seconds that only an error causes (it is in the `except`, or success has left the loop before it) or
  that the `except` sets. A loop that waits for its next item, or that looks periodically whether or not the last
  look failed, is not a retry.
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
from collections.abc import Iterable, Iterator
from pathlib import Path

PACKAGES = ("wayside", "detector", "application_manager")
LATER = {
    "detector/mining": "replays over many recordings, on one machine or on Dask (issue 20)",
}
"""The folders of features that came after aa53a00a, where the count of this structure begins, and why they are there.
None of them existed then, so that no revision is counted without what another one has elsewhere."""

SMALL = 30
_PAUSES = frozenset({"sleep", "wait", "wait_for", "pause"})
_LOOPS = ast.While | ast.For | ast.AsyncFor
_SCOPES = _LOOPS | ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef
_LEAVING = ast.Return | ast.Break | ast.Raise


class Module:
    """One module of a package."""

    def __init__(self, root: Path, path: Path) -> None:
        self.name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        self.is_package = path.name == "__init__.py"
        self.is_later = any(path.is_relative_to(root / folder) for folder in LATER)
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
        """How many loops try again after an error."""
        return sum(_is_retry(loop) for loop in ast.walk(self.tree) if isinstance(loop, _LOOPS))


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
        if any(Path(folder).parts[0] == package for folder in LATER):
            kept = [each for each in modules if not each.is_later]
            found[f"{package}: lines without later features"] = sum(each.lines for each in kept)
            found[f"{package}: modules without later features"] = len(kept)
        found[f"{package}: longest module, lines"] = max(each.lines for each in modules)
        found[f"{package}: loose modules"] = sum(each.name.count(".") == 1 and not each.is_package for each in modules)
        own = [each for each in layers if each.get("layers", [""])[0].startswith(f"{package}.")]
        found[f"{package}: floors"] = max((len(each["layers"]) for each in own), default=0)
    kept = [each for each in every if not each.is_later]
    found["all: lines"] = sum(each.lines for each in every)
    found["all: modules"] = len(every)
    found["all: lines without later features"] = sum(each.lines for each in kept)
    found["all: modules without later features"] = len(kept)
    importers: Counter[str] = Counter(name for each in every for name in set(each.imports()))
    found["small modules with one importer"] = sum(
        each.lines < SMALL and not each.is_package and importers[each.name] == 1 for each in every
    )
    names = Counter(name for each in every for name in each.public())
    found["public names defined twice or more"] = sum(count > 1 for count in names.values())
    found["retries written by hand"] = sum(each.retries() for each in every)
    return found


def _is_retry(loop: ast.While | ast.For | ast.AsyncFor) -> bool:
    """Whether the loop tries again after an error: see the module's docstring."""
    for attempt in _own(loop.body):
        if not isinstance(attempt, ast.Try):
            continue
        staying = [each for each in attempt.handlers if not isinstance(each.body[-1], _LEAVING)]
        if any(_pauses(each) for handler in staying for each in _own(handler.body)):
            return True
        tried = list(_own([*attempt.body, *attempt.orelse]))
        leaves = any(isinstance(each, _LEAVING) for each in tried)
        given = {
            each.id
            for handler in staying
            for each in _own(handler.body)
            if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
        }
        for each in _own(loop.body):
            if each in tried:
                continue
            if staying and leaves and _pauses(each):
                return True
            if isinstance(each, ast.Call | ast.If) and given & _read(each) and any(map(_pauses, ast.walk(each))):
                return True
    return False


def _own(body: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """The nodes of a body, without those of inner loops and functions."""
    for node in body:
        yield node
        if not isinstance(node, _SCOPES):
            yield from _own(ast.iter_child_nodes(node))


def _pauses(node: ast.AST) -> bool:
    """Whether it is a call that pauses for some seconds, not one that waits for an event however long that takes."""
    if not isinstance(node, ast.Call) or _called(node).strip("_") not in _PAUSES:
        return False
    return len(node.args) + len(node.keywords) > (_called(node) == "wait_for")


def _read(node: ast.Call | ast.If) -> set[str]:
    """The names that the length of a pause, or whether there is one, depends on."""
    looked = [node.test] if isinstance(node, ast.If) else [*node.args, *node.keywords]
    return {each.id for part in looked for each in ast.walk(part) if isinstance(each, ast.Name)}


def _called(call: ast.Call) -> str:
    """The last part of the name of what is called."""
    match call.func:
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name
        case _:
            return ""


if __name__ == "__main__":
    main()
