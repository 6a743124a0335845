"""docs/security.md refers to existing tests, alerts and metrics."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import yaml

from charts.generate import FILES
from detector.status.metrics import DETECTOR
from tests.guides import ROOT, guide

TESTS = ROOT / "tests"
GUIDE = guide("security")
NAMED = re.findall(r"\b((?:unit|process|cluster|e2e)/[\w/]+\.py)::(\w+)", GUIDE)


def test_every_test_that_it_names_exists() -> None:
    assert len(NAMED) > 30
    missing = [f"{file}::{name}" for file, name in NAMED if name not in _tests(TESTS / file)]
    assert missing == []


def _tests(file: Path) -> set[str]:
    if not file.exists():
        return set()
    return {node.name for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.FunctionDef)}


def test_every_row_of_a_table_of_limits_names_one() -> None:
    tables = [
        table
        for table in re.split(r"\n\n", GUIDE)
        if re.search(r"^\| (limit|attack) .*\| test \|$", table, re.MULTILINE)
    ]
    assert len(tables) > 4
    rows = [row for table in tables for row in table.splitlines()[2:]]
    assert len(rows) > 20
    assert [row for row in rows if "::test_" not in row] == []


def test_alerts_and_metrics_are_there() -> None:
    alerts = {
        rule["alert"]
        for group in yaml.safe_load((FILES / "monitoring" / "alerts.yaml").read_text())["groups"]
        for rule in group["rules"]
    }
    named = set(re.findall(r"`(Wayside[A-Z]\w+)`", GUIDE))
    assert len(named) == 3
    assert named <= alerts
    metrics = {f"wayside_detector_{name}" for name, *_ in DETECTOR}
    assert set(re.findall(r"`(wayside_detector_\w+)`", GUIDE)) <= metrics
