"""The engine: subjects and their order, and episodes from start to end."""

from __future__ import annotations

from detector.assembly import make_engine, stream_readers
from tests.driving import POSITION, Drive, a_detector, a_rule, a_stream, arrival, at, compiled, place, speed
from tests.unit.engine.rules import near, speeding


def test_an_episode_reports_when_its_condition_began_to_hold_and_when_it_started_and_ended() -> None:
    drive = Drive(a_detector(), speeding(**{"for": "2s"}, cooldown="3s", description="fast"))
    reported = drive.take(*(speed(n + 0.5, 20 if n in (1, 2, 3, 5, 6, 7, 8, 9) else 5) for n in range(12)), until=12)
    assert reported == ["r car started 4", "r car Until 5", "r car started 10", "r car Until 11"]
    first, last, second, _ = drive.events
    assert (first.episode.onset_time, first.episode.start_time, first.end_time) == (at(2), at(4), None)
    assert (last.episode.onset_time, last.episode.start_time, last.end_time) == (at(2), at(4), at(5))
    assert first.episode == last.episode != second.episode
    assert second.episode.onset_time == at(8)  # the cooldown lasts to 8
    assert first.values == {"speed": 20}
    assert last.values == {"speed": 5}


def test_two_detectors_with_the_same_input_have_separate_episodes() -> None:
    episodes = set()
    for holder in ("north", "south"):
        engine = make_engine(a_detector(), stream_readers(a_detector()), holder=holder, start=at(0))
        engine.set_rules(compiled(a_detector(), speeding()))
        (event,) = engine.advance([speed(0.5, 20)], at(1))
        episodes.add(event.episode.id)
    assert len(episodes) == 2


def test_a_condition_may_use_the_clients_name_labels_and_streams() -> None:
    detector = a_detector(clients=[{"name": "rsu", "labels": {"role": "roadside"}}])
    rule = a_rule(
        scope={"client": {"where": 'has(labels.role) && "speed" in streams'}}, when="client == 'rsu'", until="false"
    )
    drive = Drive(detector, rule)
    assert drive.take(speed(0.5, 0, "car"), place(0.5, "rsu", 0), until=1) == []  # no sample on speed
    assert drive.take(speed(1.5, 0, "rsu"), until=2) == ["r rsu started 2"]
    reported = drive.take(*(place(2 + n, "rsu", 0) for n in range(35)), until=36)
    assert reported == ["r rsu OutOfScope 7"]  # speed is stale, the client is not lost


def test_a_pair_is_evaluated_once_with_the_smaller_name_first() -> None:
    drive = Drive(a_detector(), near(when="a.position.x > b.position.x"))
    assert drive.take(place(0.5, "car2", 0), place(0.6, "car10", 100), place(0.7, "b", -9), until=1) == [
        "near car10+car2 started 1"
    ]
    (event,) = drive.events
    assert event.episode.clients == ("car10", "car2")
    assert event.values["distance"] == 100
    assert event.values["a"] == {"client": "car10", "position": {"x": 100, "y": 0, "z": 0}}


def test_reach_gates_the_start_and_not_the_end() -> None:
    rule = near(scope={"pairs": {"position": POSITION, "within": 50}})
    drive = Drive(a_detector(), rule)
    assert drive.take(place(0.5, "a", 0), place(0.5, "b", 60), until=1) == []
    assert drive.take(place(1.5, "b", 50), until=2) == ["near a+b started 2"]
    assert drive.take(place(2.5, "b", 190), until=3) == []
    assert drive.take(place(3.5, "b", 201), until=4) == ["near a+b Until 4"]


def test_where_turning_false_ends_a_pairs_episode_as_out_of_scope() -> None:
    rule = near(
        scope={"pairs": {"position": POSITION, "within": 250, "where": '"speed" in a.streams && "speed" in b.streams'}}
    )
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="3s"))
    drive = Drive(detector, rule)
    both = [each for n in range(8) for each in (place(n + 0.5, "a", 0), place(n + 0.5, "b", 100))]
    heard = [*both, speed(0.2, 1, "a"), speed(1.2, 1, "b")]
    assert drive.take(*sorted(heard), until=8) == ["near a+b started 2", "near a+b OutOfScope 4"]


def test_a_position_unknown_for_at_most_the_hold_time_keeps_the_onset() -> None:
    detector = a_detector(a_stream("pose", staleAfter="1s"))
    drive = Drive(detector, near(**{"for": "3s"}))
    reported = drive.take(
        *sorted(each for t in (0.5, 4.5) for each in (place(t, "a", 0), place(t, "b", 100))),
        until=5,
    )
    assert reported == ["near a+b started 5"]
    assert drive.events[0].episode.onset_time == at(1)


def test_a_pair_in_three_dimensions() -> None:
    position = {**POSITION, "z": "msg.z"}
    rule = near(scope={"pairs": {"position": position, "within": 5}}, when="distance == 3.0")
    drive = Drive(a_detector(), rule)
    reported = drive.take(
        arrival(0.5, "a", {"x": 1, "y": 2, "z": 2}, "pose"),
        arrival(0.5, "b", {"x": 0, "y": 0, "z": 0}, "pose"),
        until=1,
    )
    assert reported == ["near a+b started 1"]


def test_events_of_a_tick_are_ordered_by_rule_and_subject_not_by_arrival() -> None:
    rules = [speeding("b"), speeding("a", until="speed < 5"), near("ab")]
    drive = Drive(a_detector(), *rules)
    reported = drive.take(
        *(speed(0.1 + n / 100, 20, client) for n, client in enumerate(("z", "a", "m"))),
        *(place(0.5 + n / 100, client, 0) for n, client in enumerate(("z", "m", "a"))),
        until=1,
    )
    assert reported == [
        *("a a started 1", "a m started 1", "a z started 1"),
        *("ab a+m started 1", "ab a+z started 1", "ab m+z started 1"),
        *("b a started 1", "b m started 1", "b z started 1"),
    ]


def test_lost_starting_and_ending_subjects_of_a_tick_are_in_order() -> None:
    drive = Drive(a_detector(clientTimeout="3s"), speeding())
    drive.take(*(speed(0.5, 20, client) for client in ("b", "d")), until=1)
    reported = drive.take(speed(3.9, 1, "d"), speed(3.9, 20, "c"), speed(3.9, 20, "a"), until=4)
    assert reported == ["r a started 4", "r b ClientLost 4", "r c started 4", "r d Until 4"]


def test_a_client_gone_longer_than_the_timeout_ends_its_episodes_and_pairs() -> None:
    detector = a_detector(clientTimeout="5s")
    drive = Drive(detector, speeding(), near(), speeding("calm", when="speed > 90"))
    reported = drive.take(*sorted([speed(1, 20, "a"), place(1, "a", 0), place(1, "b", 9)]), until=1)
    assert reported == ["near a+b started 1", "r a started 1"]
    assert drive.take(*(place(2 + n, "b", 9) for n in range(5)), until=6) == []  # exactly the timeout is not longer
    assert drive.take(place(6.5, "b", 9), until=7) == ["near a+b ClientLost 7", "r a ClientLost 7"]
    assert list(drive.engine.clients) == ["b"]


def test_a_pending_onset_of_a_lost_client_is_forgotten() -> None:
    drive = Drive(a_detector(a_stream("speed", staleAfter="Never"), clientTimeout="3s"), speeding(**{"for": "4s"}))
    assert drive.take(speed(0.5, 20), until=4) == []
    assert drive.take(speed(4.5, 20), speed(7, 20), until=8) == []  # it would have started at 5
    assert drive.take(until=9) == ["r car started 9"]


def test_a_latched_sample_of_a_lost_client_is_valid_when_it_returns() -> None:
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="Never"), clientTimeout="3s")
    drive = Drive(detector, speeding())
    assert drive.take(speed(0.5, 20), until=9) == ["r car started 1", "r car ClientLost 4"]
    assert drive.take(place(9.5, "car", 0), until=10) == ["r car started 10"]


def test_an_episode_whose_condition_stays_unknown_ends_as_unknown() -> None:
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="2s"))
    reported = {}
    for timeout in ({"unknownTimeout": "4s"}, {}):
        drive = Drive(detector, speeding(**timeout))
        alive = [place(n + 0.1, "car", 0) for n in range(50)]
        reported[len(timeout)] = drive.take(*sorted([speed(0.5, 20), *alive]), until=50)
    assert reported[1] == ["r car started 1", "r car Unknown 7"]  # stale from 3 on
    assert reported[0] == ["r car started 1", "r car Unknown 33"]  # by default, the Detector's clientTimeout
