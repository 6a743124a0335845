"""Plugins in separate processes give the same values; one that hangs or dies is stopped while others continue."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.plugins.instances import LocalHost
from detector.plugins.outages import Outages
from detector.plugins.processes import ProcessHost
from tests.driving import a_detector, arrival
from tests.patience import PATIENCE
from tests.plugins.rules import PluginDrive, plugin_rule, plugins

__all__ = ["plugins"]  # a fixture

pytestmark = pytest.mark.usefixtures("plugins")


class Clock:
    """The clock for the pauses between starts, which the test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def host() -> Iterator[ProcessHost]:
    with closing(ProcessHost(wait=True, patience=PATIENCE)) as made:
        yield made


def values(events: list[Event]) -> list[Any]:
    return [event.to_json() for event in events]


def some_arrivals() -> list[Arrival]:
    """At tick t the newest value of client a is 4t - 6, from tick 2 on."""
    return [arrival(1.3 + n / 4, "ab"[n % 2], {"v": n}) for n in range(24)]


def test_a_plugin_in_a_separate_process_gives_the_same_events(host: ProcessHost) -> None:
    rule = plugin_rule(when="p.count >= 3 && p.v != 12", parameters={"raiseAt": 6})
    driven = [PluginDrive(a_detector(), rule, host=each) for each in (host, LocalHost())]
    for drive in driven:
        drive.take(*some_arrivals(), until=7)
    assert driven[0].events
    assert values(driven[0].events) == values(driven[1].events)
    counters = [drive.engine.counters.rule("r") for drive in driven]
    assert counters[0].errors == counters[1].errors > 0
    assert counters[0].last_error == counters[1].last_error


def stuck(host: ProcessHost, **parameters: Any) -> PluginDrive:
    """A drive in which the plugin of rule r goes wrong at 2.5 s; rule z continues."""
    rules = plugin_rule("r", parameters=parameters), plugin_rule("z", when="p.count >= 5")
    drive = PluginDrive(a_detector(), *rules, host=host)
    for seconds, value in ((0.5, 1), (2.4, 7), (3.5, 1)):
        drive.take(arrival(seconds, "a", {"v": value}), until=math.floor(seconds))
    return drive


def test_a_plugin_that_exits_is_reported_and_the_others_continue(host: ProcessHost) -> None:
    drive = stuck(host, exitAt=7)
    assert drive.take(until=6) == ["z a started 5"]
    counters = drive.engine.counters.rule("r")
    assert counters.errors == 1
    assert counters.last_error.startswith("signal p: plugin counting: its process exited; stopped")
    assert counters.unknowns == 3 + 4  # the error of the signal, and those of the condition


def test_a_hanging_plugin_is_stopped_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    with closing(ProcessHost(wait=True, patience=PATIENCE)) as host:
        drive = PluginDrive(a_detector(), plugin_rule("r", parameters={"hangAt": 7}), plugin_rule("z"), host=host)
        drive.take(arrival(0.5, "a", {"v": 1}), until=1)
        process = host._signals["r", "p"]._process
        host._patience = 5.0  # the other plugin must also answer within it
        assert drive.take(arrival(1.5, "a", {"v": 7}), until=2) == []
        host._patience = PATIENCE
        assert drive.take(until=4) == ["z a started 3"]
        assert process is not None
        assert process.returncode is not None
        assert "its process did not return a value in time; stopped" in caplog.text
        assert "EventRule r, signal p, plugin counting" in caplog.text


def test_a_live_plugin_is_restarted_up_to_three_times_with_a_pause() -> None:
    clock = Clock()
    with closing(ProcessHost(patience=PATIENCE, monotonic=clock)) as host:
        drive = PluginDrive(a_detector(), plugin_rule(parameters={"exitAt": 7}), host=host)
        for start, pause in enumerate((1, 10, 60, 1000)):
            wait_for_it(host, drive, start * 100)
            drive.take(arrival(start * 100 + 50, "a", {"v": 7}), until=start * 100 + 51)
            assert host._signals["r", "p"]._process is None
            clock.now += pause
        assert "stopped until the rule changes" in host._signals["r", "p"].why
        drive.take(until=500)
        assert host._signals["r", "p"]._process is None


def wait_for_it(host: ProcessHost, drive: PluginDrive, seconds: int) -> None:
    """Evaluate until the plugin returns values; its process starts meanwhile."""
    drive.take(arrival(seconds + 0.5, "a", {"v": 1}), until=seconds + 1)
    assert host._signals["r", "p"].is_ready(PATIENCE, again=False)


def test_a_replay_with_the_recorded_plugin_outages_gives_the_same_events() -> None:
    """Live, the plugin starts, gives values, ends, and is started again; a replay with the same outages agrees."""
    clock = Clock()
    rule = plugin_rule(when="p.count >= 2", until="p.count >= 4", parameters={"exitAt": 6})
    with closing(ProcessHost(patience=PATIENCE, monotonic=clock)) as host:
        live = PluginDrive(a_detector(), rule, host=host)
        wait_for_it(host, live, 0)
        live.take(*some_arrivals(), until=6)
        clock.now += 5
        live.take(until=7)
        wait_for_it(host, live, 7)
        live.take(until=14)
        reported = host.outages.take_changes()
    assert [(each["call"], each["running"]) for each in reported][:2] == [(1, False), (2, True)]
    assert len(reported) == 4
    again = [arrival(0.5, "a", {"v": 1}), *some_arrivals(), arrival(7.5, "a", {"v": 1})]
    with closing(ProcessHost(Outages(lambda: reported), wait=True, patience=PATIENCE)) as host:
        replayed = PluginDrive(a_detector(), rule, host=host)
        for each, until in ((again[:1], 1), (again[1:-1], 7), (again[-1:], 14)):
            replayed.take(*each, until=until)
        assert host.outages.take_changes() == []
    assert live.events
    assert values(live.events) == values(replayed.events)


def test_removing_a_rule_stops_its_plugin_process(host: ProcessHost) -> None:
    drive = PluginDrive(a_detector(), plugin_rule(), host=host)
    drive.take(arrival(0.5, "a", {"v": 1}), until=1)
    process = host._signals["r", "p"]._process
    assert process is not None
    drive.engine.set_rules([])
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)


def test_the_shipped_plugin_loads_its_dependencies_before_its_first_call() -> None:
    """A value must be returned within half a second; importing scipy takes longer."""
    program = """
        import sys
        from detector.plugins.instances import Instances
        assert "scipy.optimize" not in sys.modules
        Instances("unmatched-objects", {"objects": {"stream": "tracks"}})
        assert "scipy.optimize" in sys.modules
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(program)], check=True)
