"""`make mutants`: makes the small wrong changes of mutants.yaml one by one, and looks whether the tests notice.

Each change is made in a copy of the tree. It is caught if a test fails, and survives if all pass. The exit code is 1 if
one survives, does not apply any more or keeps the tests from running, and 2 if the tests fail without any change.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).parent / "mutants.yaml"
_PYTEST = (
    *(sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider"),
    *("--hypothesis-seed=0", "--hypothesis-profile=unshrunk"),
)
_PASSED, _FAILED = 0, 1
"""Exit codes of pytest. All others mean that it could not run the tests."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """A wrong change.

    Attributes:
        file: the path from the root of the tree.
        right: text that occurs exactly once in the file.
        wrong: what stands in its place in the mutant.
        why: what goes wrong for users.
        tests: the arguments for pytest; one of these tests fails.
    """

    name: str
    file: str
    right: str
    wrong: str
    why: str
    tests: tuple[str, ...]

    @property
    def kind(self) -> str:
        """The folder below tests/ that catches it."""
        return self.tests[0].split("/")[1]

    def applied(self) -> str:
        """The file's text with the change. Raises ValueError if the text to change is not there exactly once."""
        text = (ROOT / self.file).read_text(encoding="utf-8")
        if (count := text.count(self.right)) != 1:
            raise ValueError(f"{self.file} has the text to change {count} times: adapt `right` in {LIST.name}")
        return text.replace(self.right, self.wrong)


def mutants() -> list[Mutant]:
    """All mutants, in the order of the list."""
    listed = yaml.safe_load(LIST.read_text(encoding="utf-8"))
    return [Mutant(**{**each, "tests": tuple(each["tests"].split())}) for each in listed]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="the mutants; default: all")
    parser.add_argument("--caught-by", nargs="+", metavar="FOLDER", help="only those that tests in tests/FOLDER catch")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="how many at once; default: 2")
    options = parser.parse_args()
    chosen = [
        each
        for each in mutants()
        if (not options.names or each.name in options.names)
        and (not options.caught_by or each.kind in options.caught_by)
    ]
    if unknown := {*options.names} - {each.name for each in mutants()}:
        print(f"no such mutant: {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
        copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for number in range(options.jobs):
            copies.put(_copy(Path(scratch) / str(number)))
        if not _tests_pass(chosen, Path(scratch) / "0"):
            return 2
        with ThreadPoolExecutor(options.jobs) as pool:
            caught = [*pool.map(lambda each: _is_caught(each, copies), chosen)]
    print(f"{sum(caught)} of {len(caught)} mutants caught")
    return 0 if all(caught) else 1


def _copy(to: Path) -> Path:
    """The files of the tree that Git knows or would take, as they are now."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)
    return to


def _tests_pass(chosen: Iterable[Mutant], copy: Path) -> bool:
    """Whether the tests pass without a change: otherwise a failure would mean nothing."""
    done = _run(sorted({test for each in chosen for test in each.tests}), copy)
    if done.returncode != _PASSED:
        print(f"the tests do not pass as they are:\n{done.stdout[-4000:]}", file=sys.stderr)
    return done.returncode == _PASSED


def _is_caught(mutant: Mutant, copies: queue.SimpleQueue[Path]) -> bool:
    copy = copies.get()
    began = time.monotonic()
    try:
        found = _verdict(mutant, copy)
    finally:
        copies.put(copy)
    print(f"{found:12} {time.monotonic() - began:5.0f} s  {mutant.name}: {mutant.file}", flush=True)
    return found == "caught"


def _verdict(mutant: Mutant, copy: Path) -> str:
    file = copy / mutant.file
    try:
        changed = mutant.applied()
    except ValueError as error:
        print(error, file=sys.stderr)
        return "not applied"
    _write(file, changed)
    try:
        done = _run(mutant.tests, copy)
    finally:
        _write(file, (ROOT / mutant.file).read_text(encoding="utf-8"))
    if done.returncode not in (_PASSED, _FAILED):
        print(f"{mutant.name}: the tests did not run:\n{done.stdout[-4000:]}", file=sys.stderr)
        return "broken"
    return "survived" if done.returncode == _PASSED else "caught"


def _write(file: Path, text: str) -> None:
    file.write_text(text, encoding="utf-8")
    if file.suffix == ".py":
        # Python takes bytecode for current if size and time in seconds agree, which may be so after a small change.
        Path(importlib.util.cache_from_source(str(file))).unlink(missing_ok=True)


def _run(tests: Iterable[str], copy: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(copy)}  # the copy's packages, also in processes that tests start
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # compiling everything each time takes longer than most tests
    return subprocess.run(
        [*_PYTEST, *tests], cwd=copy, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        check=False,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
