"""Every mutant applies to the code as it is, so that a change of the code does not silently take a check away."""

from __future__ import annotations

import pytest

from tests.mutants.__main__ import ROOT, Mutant, mutants


@pytest.mark.parametrize("mutant", mutants(), ids=lambda each: each.name)
def test_a_mutant_applies_and_its_tests_exist(mutant: Mutant) -> None:
    assert mutant.applied() != (ROOT / mutant.file).read_text(encoding="utf-8")
    files = [each.partition("::")[0] for each in mutant.tests if each.startswith("tests/")]
    assert files
    assert [each for each in files if not (ROOT / each).exists()] == []
