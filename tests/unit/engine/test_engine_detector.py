"""A Detector that changes while the engine runs: samples with unchanged decoding stay, others are dropped."""

from __future__ import annotations

from typing import Any

import pytest

from detector.assembly import stream_readers
from tests.driving import POSITION, SECOND, Drive, a_deploy, a_detector, a_rule, a_stream, arrival, at, compiled
from wayside.rules import RuleError

SPEED = {"name": "v", "stream": "speed", "value": "msg.v", "aggregate": "Max", "over": "5s"}
RULE = a_rule(signals=[SPEED], when="v > 10", actions=[a_deploy("x")])


def change(drive: Drive, *streams: Any, rules: Any = (RULE,), **spec: Any) -> list[str]:
    """Switch to another Detector and the rules compiled against it."""
    detector = a_detector(*streams, **spec)
    readers = stream_readers(detector)
    drive.engine.set_detector(detector, readers.decoders, readers.read_key)
    return drive.note(drive.engine.set_rules(compiled(detector, *rules)))


def started() -> Drive:
    """An episode is open, from a sample at 0.5."""
    drive = Drive(a_detector(), RULE)
    assert drive.take(arrival(0.5, "car", {"v": 20}), until=1) == ["r car started 1"]
    return drive


def test_samples_and_episodes_stay_where_nothing_of_theirs_changed() -> None:
    drive = started()
    assert change(drive, a_stream("speed", staleAfter="9s"), a_stream("more"), clientTimeout="20s") == []
    assert len(drive.engine.demands()) == 1
    assert drive.take(arrival(2.5, "car", {"v": 1}), until=5) == []  # the window still holds the 20
    assert drive.take(until=6) == ["r car Until 6"]


def test_samples_whose_decoding_changed_are_dropped() -> None:
    drive = started()
    moved = a_stream("speed") | {"key": "v2/${client:*}/speed"}
    assert change(drive, a_stream("pose"), moved) == []
    assert [lane for lane in drive.engine.buffer if lane.stream == "speed"] == []
    assert drive.engine.buffer.bytes == 0
    assert drive.take(arrival(1.5, "car", {"v": 1}), until=2) == []  # the old key names no client any more
    assert drive.engine.counters.unnamed == {"speed": 1}


def test_removing_a_stream_drops_its_samples_and_later_ones_are_counted() -> None:
    drive = started()
    near = a_rule("near", scope={"pairs": {"position": POSITION, "within": 9}}, when="distance < 5")
    assert change(drive, a_stream("pose"), rules=(near,)) == ["r car RuleChanged 1"]
    drive.take(arrival(1.5, "car", {"v": 20}), until=3)
    assert drive.engine.counters.unnamed == {"speed": 1}
    assert list(drive.engine.buffer) == []


def test_a_changed_duration_applies_to_buffered_samples() -> None:
    drive = Drive(a_detector())
    drive.take(*(arrival(n / 10, "car", {"v": 1}) for n in range(1, 60)), until=6)
    change(drive, a_stream("pose"), a_stream("speed", buffer={"duration": "2s"}), rules=())
    drive.take(until=7)
    (lane,) = drive.engine.buffer
    assert lane.samples[0].time == at(5.1)


def test_labels_and_timeouts_of_the_new_detector_apply() -> None:
    rule = a_rule(when='has(labels.role) && labels.role == "bus"')
    drive = Drive(a_detector(), rule)
    assert drive.take(arrival(0.5, "car", {}), until=1) == []
    change(drive, rules=(rule,), clients=[{"name": "car", "labels": {"role": "bus"}}], clientTimeout="3s")
    assert drive.take(until=4) == ["r car started 2", "r car ClientLost 4"]


def test_open_episodes_continue_when_the_clock_changes() -> None:
    drive = started()
    stamped = a_stream("speed", stamp="msg.t")
    assert change(drive, stamped, clock="Data", maxAhead="10s") == []
    assert not drive.engine.on_wall_clock
    assert len(drive.engine.demands()) == 1

    def sent(t: float, v: float) -> Any:
        return arrival(2, "car", {"t": at(t) / SECOND, "v": v})

    assert drive.take(sent(1000.2, 20), sent(1000.9, 20), sent(1003.5, 1), until=3) == []
    assert drive.take(sent(1006.9, 1), sent(1009.9, 1), until=3) == ["r car Until 1006"]
    assert change(drive, stamped) == []
    assert drive.engine.on_wall_clock


def test_a_detector_that_cannot_run_changes_nothing() -> None:
    drive = started()
    broken = a_detector(a_stream("pose"), a_stream("speed", stamp="msg."))
    before = drive.engine.detector
    good = stream_readers(a_detector())
    with pytest.raises(RuleError, match=r"spec\.streams\[1\]\.stamp"):
        drive.engine.set_detector(broken, good.decoders, good.read_key)
    assert drive.engine.detector is before
    assert drive.take(until=5) == []
    assert drive.take(arrival(5.8, "car", {"v": 1}), until=6) == ["r car Until 6"]


STAMPED = {"key": "vehicles/${client:*}/speed", "name": "speed", "encoding": "json", "stamp": "msg.t"}


def stamped(client: str, seconds: float, size: int = 0) -> Any:
    return arrival(1, client, {"t": at(seconds) / 1e9, "fill": "x" * size})


def of_data(**spec: Any) -> Drive:
    """Two clients, and a drive that has begun."""
    drive = Drive(a_detector(STAMPED, clock="Data", **spec))
    drive.take(stamped("a", 1), stamped("b", 1), stamped("a", 2), stamped("b", 2), until=1)
    return drive


def test_a_changed_client_timeout_decides_when_one_client_alone_can_advance_the_time() -> None:
    alone = [stamped("a", seconds) for seconds in (3600, 3601, 3602, 3603)]
    for timeout, jumps in (("30s", 0), ("2s", 1)):
        drive = of_data()
        change(drive, STAMPED, rules=(), clock="Data", clientTimeout=timeout)
        drive.take(*alone, until=1)
        assert drive.engine.timeline.jumps == jumps  # type: ignore[union-attr]


def test_a_changed_buffer_cap_applies_to_samples_awaiting_their_tick() -> None:
    drive = of_data(lateness="10s", buffer={"bytes": "1Mi"})
    change(drive, STAMPED, rules=(), clock="Data", lateness="10s", buffer={"bytes": "2Ki"})
    drive.take(*(stamped("b", 2 + number / 10, size=500) for number in range(8)), until=1)
    assert drive.engine.timeline.dropped_full > 0  # type: ignore[union-attr]
