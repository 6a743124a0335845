"""The Detectors in docs/sources.md can run, as far as their examples go."""

from typing import Any

import pytest
import yaml

from detector.assembly import stream_readers
from detector.sources.registry import source_plugin_problems
from tests.driving import a_detector
from tests.guides import guide, yaml_blocks

SPECS = [yaml.safe_load(block)["spec"] for block in yaml_blocks(guide("sources"))]


@pytest.mark.parametrize("spec", SPECS, ids=["zenoh", "plugins"])
def test_examples_have_no_errors(spec: dict[str, Any]) -> None:
    streams = spec.pop("streams")
    detector = a_detector(*streams, **spec)
    stream_readers(detector)
    assert [*source_plugin_problems(detector)] == []
