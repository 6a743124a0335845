"""Times of evaluation: with samples, on demand, paused, under load; and the maximum rate."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any

import pytest
from pydantic import ValidationError

from detector.engine.engine import NotEvaluableError
from detector.engine.samples.sample import Arrival
from detector.engine.timing.schedule import CALM, LONG, Overload, highest_level, thinning
from detector.live.evaluator import Evaluator
from detector.replay.intake_file import Control
from detector.replay.replaying import replay_intake
from tests.driving import (
    POSITION,
    SECOND,
    SPEED,
    START,
    Drive,
    a_detector,
    a_rule,
    a_stream,
    arrival,
    at,
    compiled,
    lines,
    place,
    speed,
)
from tests.networks import wait_for
from tests.patience import PATIENCE
from tests.unit.engine.live import Live


def fast(name: str = "r", **spec: Any) -> Any:
    return a_rule(name, **{"signals": [SPEED], "when": "speed > 10", "evaluation": {"onSample": "speed"}, **spec})


def test_with_on_sample_a_rule_is_evaluated_at_the_time_of_each_sample() -> None:
    drive = Drive(a_detector(), fast())
    reported = drive.take(speed(0.25, 5), place(0.26, "car", 1), speed(0.3, 20), speed(0.7, 5), until=2)
    assert reported == ["r car started 0.3", "r car Until 0.7"]
    assert drive.engine.counters.rule("r").evaluations == 3


def test_with_on_sample_other_clients_are_not_evaluated() -> None:
    drive = Drive(
        a_detector(), fast(signals=[{"name": "age", "stream": "speed", "aggregate": "Age"}], when="age > 0.1")
    )
    assert drive.take(speed(0.1, 0, "a"), speed(0.3, 0, "b"), until=0.9) == []
    assert drive.engine.counters.rule("r").evaluations == 2


def test_the_end_of_for_wakes_a_rule_with_on_sample() -> None:
    drive = Drive(a_detector(), fast(**{"for": "2s"}))
    assert drive.take(speed(0.3, 20), until=5) == ["r car started 2.3"]


def test_the_end_of_a_cooldown_wakes_a_rule_with_on_sample() -> None:
    drive = Drive(a_detector(), fast(cooldown="3s", until="speed > 30"))
    reported = drive.take(speed(0.3, 20), speed(0.5, 40), speed(0.6, 20), until=6)
    assert reported == ["r car started 0.3", "r car Until 0.5", "r car started 3.5"]


def test_the_end_of_the_unknown_timeout_wakes_a_rule_with_on_sample() -> None:
    drive = Drive(a_detector(), fast(unknownTimeout="2s"))
    reported = drive.take(speed(0.3, 20), speed(0.5, 20), arrival(1.2, "car", {}), until=6)
    assert reported == ["r car started 0.3", "r car Unknown 3.2"]


def test_a_lost_client_ends_the_episodes_of_a_rule_with_on_sample() -> None:
    drive = Drive(a_detector(clientTimeout="5s"), fast())
    assert drive.take(speed(0.3, 20), until=9) == ["r car started 0.3", "r car ClientLost 6"]


def test_lost_and_woken_subjects_of_a_tick_are_reported_in_order() -> None:
    drive = Drive(a_detector(clientTimeout="4s"), fast(unknownTimeout="2s"))
    reported = drive.take(speed(0.1, 20, "b"), speed(0.2, 20, "a"), arrival(3, "a", {}), until=5)
    assert reported[2:] == ["r a Unknown 5", "r b ClientLost 5"]


def test_a_lost_subject_is_not_evaluated_with_samples_of_others() -> None:
    drive = Drive(a_detector(clientTimeout="2s"), fast(cooldown="20s", until="speed < 10"))
    drive.take(speed(0.3, 20, "a"), speed(0.5, 5, "a"), until=20.9)
    counters = drive.engine.counters.rule("r")
    before = counters.evaluations
    drive.take(place(21.0, "a", 0), speed(21.5, 5, "b"), until=22)
    assert counters.evaluations == before + 1


def test_with_on_sample_only_the_pairs_of_the_samples_client_are_evaluated() -> None:
    scope = {"pairs": {"position": POSITION, "within": 100}}
    rule = a_rule("near", scope=scope, when="distance < 50", evaluation={"onSample": "pose"})
    drive = Drive(a_detector(), rule)
    places = [place(0.1, "a", 0), place(0.2, "b", 10), place(0.3, "c", 20)]
    reported = drive.take(*places, until=0.9)
    assert reported == ["near a+b started 0.2", "near a+c started 0.3", "near b+c started 0.3"]


def test_with_clock_data_a_sample_is_evaluated_at_its_stamp_once_lateness_has_passed() -> None:
    detector = a_detector(a_stream("speed", stamp="msg.t"), clock="Data", lateness="500ms")
    drive = Drive(detector, fast())

    def stamped(seconds: float, value: float) -> Arrival:
        return arrival(seconds, "car", {"v": value, "t": at(seconds) / SECOND})

    first = [stamped(0.1, 5), stamped(0.4, 20), stamped(0.3, 5), stamped(0.9, 20)]
    assert drive.note(drive.engine.advance(first, 0)) == ["r car started 0.4"]
    assert drive.note(drive.engine.advance([stamped(0.5, 5), stamped(1.2, 5)], 0)) == ["r car Until 0.5"]
    assert drive.note(drive.engine.advance([stamped(2.0, 5)], 0)) == ["r car started 0.9", "r car Until 1.2"]


def test_the_batching_of_arrivals_does_not_matter() -> None:
    arrivals = [speed(0.3 * n, 20 if n % 7 > 2 else 5, "ab"[n % 2]) for n in range(1, 60)]
    rules = [fast(**{"for": "500ms"}), fast("p", evaluation={"every": "1s"})]
    whole = Drive(a_detector(), *rules)
    whole.take(*arrivals, until=20)
    parts = Drive(a_detector(), *rules)
    for each in arrivals:
        parts.take(until=(each.received - START) / SECOND - 0.1)
        parts.take(each, until=0)
    parts.take(until=20)
    assert lines(whole.events) == lines(parts.events) != []


def test_on_demand_a_rule_is_evaluated_on_request_and_reports_each_subject() -> None:
    drive = Drive(a_detector(), fast(evaluation={"onDemand": True}))
    assert drive.take(speed(0.3, 20, "a"), speed(0.4, 5, "b"), arrival(0.5, "c", {}), until=3) == []
    events, answers = drive.engine.evaluate_now("r")
    assert drive.note(events) == ["r a started 3"]
    assert [(each.subject, each.when, each.values, each.episode is not None) for each in answers] == [
        ("a", True, {"speed": 20}, True),
        ("b", False, {"speed": 5}, False),
        ("c", None, {}, False),
    ]
    assert drive.take(speed(3.5, 5, "a"), until=4) == []
    assert drive.note(drive.engine.evaluate_now("r")[0]) == ["r a Until 4"]


def test_only_rules_with_on_demand_can_be_evaluated_on_demand() -> None:
    drive = Drive(a_detector(), fast(), fast("q", evaluation={"onDemand": True}))
    with pytest.raises(NotEvaluableError, match="there is no rule x; the detector has q, r"):
        drive.engine.evaluate_now("x")
    with pytest.raises(NotEvaluableError, match="rule r is not evaluated on demand"):
        drive.engine.evaluate_now("r")
    drive.engine.set_paused({"q"})
    with pytest.raises(NotEvaluableError, match="rule q is paused"):
        drive.engine.evaluate_now("q")


def test_a_paused_rule_keeps_open_episodes_and_drops_pending_onsets() -> None:
    drive = Drive(a_detector(a_stream("speed", staleAfter="30s")), fast(**{"for": "2s"}, evaluation={"every": "1s"}))
    assert drive.take(speed(0.1, 20, "a"), speed(1.1, 20, "b"), until=3) == ["r a started 3"]
    drive.engine.set_paused({"r"})
    assert drive.take(speed(3.1, 5, "a"), until=6) == []
    drive.engine.set_paused(set())
    assert drive.take(until=10) == ["r a Until 7", "r b started 9"]


def test_episodes_beyond_the_hourly_limit_of_a_client_are_skipped_and_counted() -> None:
    drive = Drive(a_detector(clientTimeout="2h"), fast(evaluation={"every": "1s"}, maxEpisodesPerHour=2))
    blinks = [
        speed(n + 0.5, 20 if n % 2 else 5, client) for n in range(8) for client in ("a", "b") if client == "a" or n < 3
    ]
    reported = drive.take(*blinks, speed(3600.5, 5, "a"), speed(3601.5, 20, "a"), until=3602)
    assert [each for each in reported if "started" in each] == [
        "r a started 2",
        "r b started 2",
        "r a started 4",
        "r a started 3602",  # an hour after the first one
    ]
    assert drive.engine.counters.rule("r").suppressed == 2


def test_an_episode_of_a_dry_run_reports_it() -> None:
    drive = Drive(a_detector(), fast(dryRun=True), fast("real"))
    drive.take(speed(0.5, 20), until=1)
    dry, real = (event.cloud_event()["data"] for event in drive.events)
    assert dry["dryRun"] is True
    assert "dryRun" not in real


def test_under_load_rules_of_lowest_priority_are_skipped_first_and_reported() -> None:
    rules = [
        fast("low", evaluation={"every": "1s", "priority": -1}),
        fast("high", evaluation={"every": "1s"}),
        fast("sampled", evaluation={"onSample": "speed", "priority": -1}),
    ]
    drive = Drive(a_detector(), *rules)
    drive.engine.set_level(2)
    drive.take(*(speed(n + 0.5, 5) for n in range(16)), until=16)
    counts = {name: drive.engine.counters.rule(name) for name in ("low", "high", "sampled")}
    assert {name: (each.evaluations, each.skipped) for name, each in counts.items()} == {
        "low": (4, 12),
        "high": (16, 0),
        "sampled": (4, 12),
    }
    drive.engine.set_level(0)
    drive.take(speed(16.5, 5), until=17)
    assert counts["low"].evaluations == 5


def test_load_levels_thin_out_priority_by_priority() -> None:
    assert [dict(thinning(level, [5, 0, 5])) for level in (0, 1, 3, 4, 6)] == [
        {0: 1, 5: 1},
        {0: 2, 5: 1},
        {0: 8, 5: 1},
        {0: 8, 5: 2},
        {0: 8, 5: 8},
    ]
    assert highest_level([5, 0, 5]) == 6


def test_the_load_level_rises_with_each_slow_evaluation_and_falls_when_idle() -> None:
    overload = Overload()
    assert [overload.observe(n, LONG + 1, 2) for n in (0, 1, 2)] == [True, True, False]
    assert overload.level == 2
    assert [overload.observe(2 + n * CALM // 2, 0, 2) for n in (1, 2, 3, 4, 5)] == [False, True, False, True, False]
    assert overload.level == 0


def test_a_replay_with_pauses_requests_and_skipped_evaluations_gives_the_same_events() -> None:
    rules = [fast(), fast("q", evaluation={"onDemand": True}), fast("p", evaluation={"every": "1s"})]
    live = Live(a_detector(), rules)
    slow = itertools.count(0, SECOND)
    for n in range(80):
        live.engine.observers.stopwatch = partial(next, slow) if 10 < n < 20 else lambda: 0
        live.now += SECOND // 4
        payload = b'{"v": %d}' % (20 if (n // 3) % 2 else 5)
        live.put([(f"vehicles/{client}/speed", payload) for client in ("a", "b")])
        if n in (10, 20):
            live.evaluator.pause_rule("p", n == 10).result(PATIENCE)
        assert [each.subject for each in live.evaluator.evaluate_rule("q").result(PATIENCE)] == ["a", "b"]
    recording = live.stop()
    assert {event.episode.rule for event in recording.logged} == {"r", "q", "p"}
    levels = [
        each.document["level"] for each in recording.records if isinstance(each, Control) and each.kind == "level"
    ]
    assert levels == [1, 2, 3, 2]  # three at once while it was slow; one taken back after ten seconds of calm
    assert live.engine.counters.rule("r").skipped > 0
    assert lines(replay_intake(recording.records, None, None).events) == lines(recording.logged)


@pytest.mark.parametrize(
    ("evaluation", "message"),
    [
        ({"every": "1s", "onSample": "speed"}, "at most one of every, onSample and onDemand"),
        ({"onDemand": False}, "onDemand: must be true; got false"),
        ({"every": "1ms"}, "every: must be 10ms or more; got 1ms"),
    ],
)
def test_invalid_evaluation_settings_are_rejected(evaluation: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        fast(evaluation=evaluation)


def test_on_sample_names_a_stream_of_the_detector() -> None:
    with pytest.raises(
        Exception, match=r"spec\.evaluation\.onSample: Detector d has no stream sped; did you mean speed"
    ):
        compiled(a_detector(), fast(evaluation={"onSample": "sped"}))


def test_a_sample_that_triggers_rules_is_evaluated_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Evaluator, "pause", lambda _: 3600.0)
    live = Live(a_detector(), [fast(evaluation={"onSample": "speed"})])
    live.now += SECOND // 4
    live.put([("vehicles/a/speed", b'{"v": 20}')])
    wait_for(lambda: bool(live.recording.logged))
    assert [event.episode.subject for event in live.stop().logged] == ["a"]
