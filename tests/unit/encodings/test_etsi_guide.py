"""docs/etsi.md is correct: its table of units is the code's, its Detector and rule are accepted."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

from detector.assembly.checking import findings
from detector.streams.codecs.etsi.messages import KINDS, PREFIX
from detector.streams.codecs.etsi.quantities import UNITS
from tests.guides import guide, yaml_blocks
from wayside.api.documents import load_documents

GUIDE = guide("etsi")


def rows(header: str) -> list[list[str]]:
    table = GUIDE.partition(f"| {header} |")[2].partition("\n\n")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def test_the_table_of_units_is_the_codes() -> None:
    reported = {
        name: (unit, Fraction(step), {int(null)} if null else set())
        for unit, step, types, null in rows("unit")
        for name in re.sub(r" \(.*?\)", "", types).split(", ")
    }
    assert reported == {name: (unit.symbol or "1", unit.step, set(unit.null)) for name, unit in UNITS.items()}


def test_the_table_of_messages_is_the_codes() -> None:
    reported = {name.strip("`"): int(number) for name, number, *_ in rows("type")}
    assert reported == {PREFIX + kind.name: kind.number for kind in KINDS}


def test_the_example_is_accepted(tmp_path: Path) -> None:
    example = yaml_blocks(GUIDE)[0]
    file = tmp_path / "example.yaml"
    file.write_text(example)
    documents = load_documents([file])
    assert [type(document.object).__name__ for document in documents] == ["Detector", "EventRule"]
    assert not findings(documents).problems
