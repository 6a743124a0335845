"""Each case in docs/operations.md names existing tests."""

from __future__ import annotations

import ast
import re

import pytest

from tests.guides import ROOT, guide

GUIDE = guide("operations")
SECTION = GUIDE.partition("## What happens when…\n")[2].partition("\n## ")[0]
CASES = re.split(r"^(?=\*\*… )", SECTION, flags=re.MULTILINE)[1:]
NAMED = re.compile(r"^- `(tests/\S+\.py)::(test_\w+)`$", re.MULTILINE)


@pytest.mark.parametrize("case", CASES, ids=[case.partition("**… ")[2].partition(".**")[0] for case in CASES])
def test_each_case_names_tests_that_exist(case: str) -> None:
    named = NAMED.findall(case)
    assert named, "no test shows it"
    for file, test in named:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert test in {each.name for each in tree.body if isinstance(each, ast.FunctionDef)}


def test_the_main_cases_are_there() -> None:
    for what in ("node restarts", "API server", "router", "manager", "detector", "database", "disk"):
        assert any(what in case.partition("**")[2].partition("**")[0] for case in CASES), what
