"""The Detectors in docs/sources.md can run, as far as their examples go."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from detector.assembly import inlets
from detector.sources.registry import plugin_problems
from tests.driving import a_detector

GUIDE = Path(__file__).parents[3] / "docs" / "sources.md"

SPECS = [
    yaml.safe_load(block.split("```")[0])["spec"] for block in GUIDE.read_text(encoding="utf-8").split("```yaml\n")[1:]
]


@pytest.mark.parametrize("spec", SPECS, ids=["zenoh", "plugins"])
def test_an_example_has_nothing_wrong(spec: dict[str, Any]) -> None:
    streams = spec.pop("streams")
    detector = a_detector(*streams, **spec)
    inlets(detector)
    assert [*plugin_problems(detector)] == []
