"""docs/trigger.md is correct: its Detector and its rules are accepted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from detector.actions.trigger.services import KNOWN
from detector.assembly.checking import findings
from tests.guides import guide, yaml_blocks
from wayside.api.documents import load_documents

GUIDE = guide("trigger")


def test_the_examples_are_accepted(tmp_path: Path) -> None:
    blocks = yaml_blocks(GUIDE)
    rule: dict[str, Any] = yaml.safe_load(blocks[0])
    for block in blocks[2:]:
        rule["spec"]["actions"] += yaml.safe_load(block)
    assert len(rule["spec"]["actions"]) == 5
    (tmp_path / "all.yaml").write_text(yaml.safe_dump_all([rule, yaml.safe_load(blocks[1])], allow_unicode=True))
    assert findings(load_documents([tmp_path / "all.yaml"])).problems == []


def test_the_known_services_are_named() -> None:
    for name in KNOWN:
        assert f"`{name.rsplit('/', 1)[1]}`" in GUIDE
