"""Rules with plugin signals, and how tests find the plugins of tests/plugins/signals.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from detector.assembly import make_engine, stream_readers
from detector.engine.scoping.plugins import PluginHost
from tests.driving import Drive, a_rule, at, compiled
from wayside.api import Detector, EventRule

PACKAGE = Path(__file__).parent / "package"


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test package is installed."""
    monkeypatch.syspath_prepend(PACKAGE)


def plugin_rule(name: str = "r", plugin: str = "counting", when: str = "p.count >= 3", **fields: Any) -> EventRule:
    parameters = {"stream": "speed", **fields.pop("parameters", {})}
    signal = {"name": "p", "plugin": {"name": plugin, "parameters": parameters}}
    return a_rule(name, signals=[signal, *fields.pop("signals", [])], when=when, **fields)


class PluginDrive(Drive):
    """A drive whose plugins run in the given host."""

    def __init__(self, detector: Detector, *rules: EventRule, host: PluginHost) -> None:
        super().__init__(detector)
        self.host = host
        self.engine = make_engine(detector, stream_readers(detector), holder="h", start=at(0), plugins=host)
        self.engine.set_rules(compiled(detector, *rules))
