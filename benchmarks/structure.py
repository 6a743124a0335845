"""The size and complexity of the code base, compared with an older revision.

    python -m benchmarks.structure [REVISION]

For each program and the package that they share, into which much of both has moved, and for all together:

- lines and modules of Python, and the longest module;
- lines and modules without new features: without what the commits of `FEATURES` added since the older revision;
- small modules: under 30 lines, imported by exactly one other module;
- loose modules: directly in the top folder, beside the folders;
- floors: levels of the layers contract in pyproject.toml;
- names: public classes and functions that are defined in two or more modules, over all packages;
- vocabulary: the different last words of the names of public classes (`EventSink` is a sink);
- concepts: the rows of the table of concepts in docs/architecture.md;
- retries: loops that try again after an error, written by hand. Such a loop has an `except` that does not leave it, and
  a pause of some seconds that only an error causes (it is in the `except`, or success has left the loop before it) or
  that the `except` sets. A loop that waits for its next item, or that looks periodically whether or not the last
  look failed, is not a retry.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import tarfile
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

PACKAGES = ("wayside", "detector", "application_manager")
FEATURES = {
    "the engine in columns": "f09295fc 522a3e33 eac9608b 48dcfa7e a9631c4f 83699c96 cf4b4220 21b4c109 fad1fe71 b329796e"
    " 4dc68e97",
    "the manager's isolation": "68ee06aa 5407f382 37f5a471 f2b5e78f f9f01a80 278afff6 6f56813c 36f5e20c 5fac8ee6"
    " 895c5737 583ed297 fb6ad406 fbda38eb b8206c49 20548840 4f80f66a",
    "rules for real data": "44ec28f7 53bd5d8e 7d79a0df e71c255c 75947dfb 352a701a dcf60957 ca463a37 bd21f50d 3bd1011a"
    " 83c4af20 6cb020dc aa35da7c a6aea784 80413d11",
    "results to look at": "98cf54c1 16f68ec6 95544d35 da3c5a53 515a246b 7d91d8cf 0135522d 07862a81",
    "mining, pieces and regions": "b4432256 e7893edf 7ba46872 a5b5a43a eec14231 63d911ba c355b68f f6114099 21d8c0c3"
    " cd71331e",
}
"""The commits that brought features while the structure changed. What they added, less what they removed, is set apart:
it did not exist in the older revision, so that it shows nothing about the structure."""

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

    def nouns(self) -> Iterator[str]:
        """The last words of the names of the public classes that it defines."""
        for node in self.tree.body:
            if isinstance(node, ast.ClassDef) and node.name[0] != "_":
                yield re.findall("[A-Z][a-z0-9]*|[A-Z]+", node.name)[-1]

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
        command = ["git", "-C", str(root), "archive", options.revision, *PACKAGES, "docs", "pyproject.toml"]
        archive = subprocess.run(command, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        before, after = counted(Path(folder)), counted(root)
    added = brought(root, options.revision)
    print(f"{'':52}{options.revision[:12]:>12}{'now':>12}")
    for name in after:
        print(f"{name:52}{before.get(name, 0):>12,}{after[name]:>12,}")
        if name in added:
            print(f"{name + ' without new features':52}{before.get(name, 0):>12,}{after[name] - added[name]:>12,}")


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
    found["all: lines"] = sum(each.lines for each in every)
    found["all: modules"] = len(every)
    importers: Counter[str] = Counter(name for each in every for name in set(each.imports()))
    found["small modules with one importer"] = sum(
        each.lines < SMALL and not each.is_package and importers[each.name] == 1 for each in every
    )
    names = Counter(name for each in every for name in each.public())
    found["public names defined twice or more"] = sum(count > 1 for count in names.values())
    found["words that name public classes"] = len({noun for each in every for noun in each.nouns()})
    page = root / "docs" / "architecture.md"
    found["concepts listed in docs/architecture.md"] = _rows(page.read_text(encoding="utf-8")) if page.exists() else 0
    found["retries written by hand"] = sum(each.retries() for each in every)
    return found


def brought(root: Path, revision: str) -> Counter[str]:
    """The lines and modules that the commits of `FEATURES` since a revision added, less what they removed."""
    command = ["git", "-C", str(root), "log", "--no-merges", "--no-renames", "--numstat", "--summary", "--format=@%H"]
    log = subprocess.run([*command, f"{revision}..HEAD"], check=True, capture_output=True, text=True).stdout
    features = {commit for commits in FEATURES.values() for commit in commits.split()}
    added: Counter[str] = Counter()
    for entry in log.split("@")[1:]:
        commit, *changes = entry.splitlines()
        for change in changes if commit[:8] in features else ():
            match change.split():
                case [more, fewer, path] if _is_counted(path):
                    figure, number = "lines", int(more) - int(fewer)
                case ["create" | "delete" as verb, "mode", _, path] if _is_counted(path):
                    figure, number = "modules", 1 if verb == "create" else -1
                case _:
                    continue
            added[f"{path.partition('/')[0]}: {figure}"] += number
            added[f"all: {figure}"] += number
    return added


def _rows(page: str) -> int:
    """The number of rows of the table under the heading Concepts."""
    table = page.partition("\n## Concepts\n")[2].partition("\n## ")[0]
    return max(sum(line.startswith("|") for line in table.splitlines()) - 2, 0)


def _is_counted(path: str) -> bool:
    """Whether it is a module of the packages."""
    return path.endswith(".py") and path.partition("/")[0] in PACKAGES


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
