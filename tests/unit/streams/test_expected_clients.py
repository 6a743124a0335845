"""Expected clients are known from the start and are never lost, so a rule can detect that one is silent."""

from __future__ import annotations

from typing import Any

from detector.assembly import stream_readers
from tests.driving import Drive, a_detector, a_rule, a_stream, arrival, at, compiled

AGE = {"name": "age", "stream": "speed", "aggregate": "Age"}
COUNT = {"name": "count", "stream": "speed", "aggregate": "Count", "over": "5s"}


def detector(*, expected: bool = True, **spec: Any) -> Any:
    station = {"name": "rsu", "labels": {"role": "roadside"}, "expected": expected}
    return a_detector(clients=[station, {"name": "car", "labels": {"role": "vehicle"}}], clientTimeout="4s", **spec)


def silent(**spec: Any) -> Any:
    return a_rule("silent", signals=[AGE, COUNT], **{"when": "age > 3.0 && labels.role == 'roadside'", **spec})


def test_a_silent_station_is_reported_from_the_start_on_and_its_episode_holds_beyond_the_timeout() -> None:
    drive = Drive(detector(), silent())
    assert drive.take(until=60) == ["silent rsu started 4"]
    assert list(drive.engine.clients) == ["rsu"]
    assert drive.events[0].values == {"age": 4, "count": 0}
    assert drive.take(arrival(60.5, "rsu", {"v": 1}), until=61) == ["silent rsu Until 61"]
    assert drive.take(until=80) == ["silent rsu started 64"]


def test_a_listed_but_not_expected_client_is_unknown_before_its_first_sample() -> None:
    drive = Drive(detector(expected=False), silent())
    assert drive.take(until=10) == []
    assert drive.take(arrival(10.5, "rsu", {"v": 1}), until=60) == ["silent rsu started 14", "silent rsu ClientLost 15"]


def test_a_client_is_known_while_it_is_expected_and_times_out_afterwards() -> None:
    before, after = detector(expected=False), detector()
    drive = Drive(before, silent(until="false"))

    def change(wanted: Any) -> None:
        readers = stream_readers(wanted)
        drive.engine.set_detector(wanted, readers.decoders, readers.read_key)
        assert drive.note(drive.engine.set_rules(compiled(wanted, silent(until="false")))) == []

    drive.take(until=10)
    change(after)
    assert drive.take(until=20) == ["silent rsu started 14"]
    change(before)
    assert drive.take(until=24) == []
    assert drive.take(until=30) == ["silent rsu ClientLost 25"]


def test_with_clock_data_it_is_known_since_the_time_of_the_data_began() -> None:
    streams = (a_stream("pose"), a_stream("speed", stamp="msg.t"))
    wanted = a_detector(*streams, clients=[{"name": "rsu", "expected": True}], clock="Data", lateness="0s")
    drive = Drive(wanted, a_rule("silent", signals=[AGE], when="age > 3.0 && client == 'rsu'"))
    stamps = (1_000.5, 1_001, 1_002, 1_003, 1_004, 1_005)
    drive.take(*(arrival(n, "car", {"t": stamp}) for n, stamp in enumerate(stamps)), until=9)
    (event,) = drive.events
    assert event.episode.start_time == 1_004 * 10**9
    assert event.episode.start_time < at(0)
