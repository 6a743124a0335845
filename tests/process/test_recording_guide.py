"""The examples in docs/recording.md work as described, in a running detector."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from detector.assembly.checking import findings
from detector.status.model import read_status
from detector.streams.query_handler import query_detectors
from tests.patience import PATIENCE
from tests.process.running import Process
from tests.recording_bench import mcap_files, metadata_of, read_with_mcap
from wayside.api import EventRule
from wayside.api.documents import load_documents

GUIDE = Path(__file__).parents[2] / "docs" / "recording.md"
DETECTOR, RECORD_ALL, THRESHOLD = (
    yaml.safe_load(block.split("```")[0]) for block in GUIDE.read_text(encoding="utf-8").split("```yaml\n")[1:]
)


def test_the_examples_have_no_findings(tmp_path: Path) -> None:
    path = tmp_path / "all.yaml"
    path.write_text(yaml.safe_dump_all([DETECTOR, RECORD_ALL, THRESHOLD]))
    assert findings(load_documents([path])).problems == []


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    process = Process(tmp_path)
    spec: dict[str, Any] = DETECTOR["spec"]
    streams = tuple(spec["streams"])
    recordings = {**spec["recordings"], "reserve": "1Mi"}
    rules = [EventRule.model_validate(each) for each in (RECORD_ALL, THRESHOLD)]
    process.write(*rules, streams=streams, recordings=recordings)
    process.start()
    yield process
    if process.process.poll() is None:
        process.stop()


def named(folder: Path, rule: str, count: int) -> list[Path]:
    """The recordings of a rule, once this number of them exist."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = [each for each in folder.glob(f"recordings/{rule}/*") if not each.name.startswith(".")]
        if len(found) >= count:
            return sorted(found)
        time.sleep(0.05)
    raise AssertionError(f"no recording of {rule}: {[*folder.glob('recordings/*/*')]}")


def until_evaluated(process: Process, speed: float) -> None:
    """Wait until the rule has evaluated this speed."""
    end, seen = time.monotonic() + PATIENCE, []
    while seen != [speed]:
        assert time.monotonic() < end, seen
        requested = {"rule": "threshold", "subject": "car1", "wait": "30"}
        (answer,) = query_detectors(process.network, process.name, "status", requested, PATIENCE)
        explanation = read_status(answer.payload).explanation
        assert explanation is not None
        seen = [each.values.get("speed") for each in explanation.subjects]


def test_record_all_has_all_samples_and_threshold_its_window(process: Process) -> None:
    for value in (5, 20, 25, 5, 6):
        process.send("car1", {"v": value})
        until_evaluated(process, value)
    (bag,) = named(process.folder, "threshold", 1)
    assert not bag.name.endswith("_cut")
    found = [json.loads(each.payload)["v"] for file in mcap_files(bag) for each in read_with_mcap(file)]
    assert found in ([5, 20, 25, 5, 6], [5, 20, 25, 5])
    metadata = metadata_of(mcap_files(bag)[0])["metadata"]
    assert metadata == {"speed": "20.0", "note": "too fast: 72 km/h"}
    assert process.stop() == 0
    (everything,) = named(process.folder, "record-all", 1)
    assert everything.name.endswith("_part0001_cut")
    assert [json.loads(each.payload)["v"] for each in read_with_mcap(mcap_files(everything)[0])] == [5, 20, 25, 5, 6]
    assert "the detector" in json.loads((everything / "recording.json").read_text())["cut"]
    shutil.rmtree(process.folder / "recordings")
