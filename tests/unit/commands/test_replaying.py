"""Replays: tasks, pauses, and the output for users."""

from __future__ import annotations

from detector.engine.samples.intake import Intake
from detector.live.evaluator import Evaluator
from detector.replay.intake_file import Control
from detector.replay.replaying import replay_arrivals, replay_intake
from tests.driving import START, a_deploy, a_detector, a_rule, an_engine, arrival, at
from wayside.api.detector import Clock

FAST = a_rule(
    "fast",
    signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
    when="v > 10",
    actions=[a_deploy("start", parameters={"who": "${client}"})],
)
BRIEF = [arrival(0.5, "a", {"v": 20}), arrival(2.5, "a", {"v": 0}), arrival(9.0, "a", {"v": 0})]


def test_an_episode_that_starts_and_ends_between_two_writes_has_its_task_too() -> None:
    outcome = replay_arrivals([BRIEF], a_detector(), [FAST])
    (task,) = outcome.tasks.values()
    assert [event.started for event in outcome.events] == [True, False]
    assert task.spec.parameters == {"who": "a"}
    assert task.spec.end_time == "2026-01-01T00:00:03.000000000Z"


def test_with_clock_data_the_tasks_are_the_same() -> None:
    detector = a_detector({"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json", "stamp": "msg.t"})
    data = detector.model_copy(update={"spec": detector.spec.model_copy(update={"clock": Clock.DATA})})
    stamped = [
        arrival(9.0 + n, "a", {"v": v, "t": (START + t) / 1e9})
        for n, (t, v) in enumerate([(5 * 10**8, 20), (25 * 10**8, 0), (9 * 10**9, 0)])
    ]
    plain = replay_arrivals([BRIEF], detector, [FAST])
    assert {*replay_arrivals([stamped], data, [FAST]).tasks} == {*plain.tasks}


def test_an_open_episode_continues_over_a_gap_of_hours() -> None:
    detector = a_detector(clientTimeout="1h")
    outcome = replay_arrivals([[arrival(0.5, "a", {"v": 20}), arrival(8000, "a", {"v": 20})]], detector, [FAST])
    assert [event.started for event in outcome.events] == [True]
    assert any(note.startswith("the recording pauses after 2026-01-01T00:00:00.5") for note in outcome.notes)


def test_a_misspelt_field_is_reported_after_the_replay() -> None:
    rule = a_rule("fast", signals=[{"name": "v", "stream": "speed", "value": "msg.w"}], when="v > 10")
    outcome = replay_arrivals([BRIEF], a_detector(), [rule])
    (note,) = outcome.notes
    assert "unknown values" in note
    assert "EventRule fast" in note
    assert '"w"' in note


def test_a_truncated_intake_file_is_replayed_up_to_the_cut_with_a_warning() -> None:
    detector = a_detector()
    start = {"kind": "start", "holder": "h", "detector": detector.to_json(), "rules": [FAST.to_json()]}
    records = [Control(START, start), *BRIEF[:2], Control(at(2.5), {"kind": "cut", "reason": "killed"})]
    outcome = replay_intake(records, None, None)
    assert outcome.cut
    assert [event.started for event in outcome.events] == [True]


def test_a_rejected_rule_change_in_an_intake_file_ends_no_episode_as_live() -> None:
    detector = a_detector()
    broken = FAST.to_json() | {"spec": FAST.to_json()["spec"] | {"when": "w > 10"}}
    start = {"kind": "start", "holder": "h", "detector": detector.to_json(), "rules": [FAST.to_json()]}
    records = [
        Control(START, start),
        BRIEF[0],
        Control(at(1.5), {"kind": "rules", "rules": [broken]}),
        Control(at(2.0), {"kind": "end"}),
    ]
    outcome = replay_intake(records, None, None)
    assert [event.started for event in outcome.events] == [True]
    assert [refusal.kept for refusal in outcome.refusals] == [True]


class NullSink:
    """Discards events and demands."""

    def events(self, events: object) -> None: ...

    def open_episodes(self, episodes: object) -> None: ...

    def demands(self, demands: object, ended: object) -> None: ...


def test_with_clock_data_the_evaluation_sleeps_between_ticks_even_with_old_stamps() -> None:
    detector = a_detector(clock="Data")
    evaluator = Evaluator(
        an_engine(detector), Intake(lambda: START), NullSink(), now=lambda: at(1e6), on_failure=lambda error: None
    )
    assert evaluator.pause() > 0.01


def test_an_intake_file_replays_with_the_defaults_of_its_time() -> None:
    """Before there was maxAge, a place held as long as its stream was not stale, by default for clientTimeout."""
    place = {"stream": "pose", "x": "msg.x", "y": "msg.y"}
    near = a_rule("near", scope={"pairs": {"position": place, "within": 9}}, when="distance < 9", until="false")
    old = a_rule("old", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10", **{"for": "20s"})
    start = {
        "kind": "start",
        "holder": "h",
        "detector": a_detector().to_json(),
        "rules": [near.to_json(), old.to_json()],
    }
    arrivals = [
        arrival(1, "a", {"v": 20}),
        arrival(1, "a", {"x": 0, "y": 0}, "pose"),
        arrival(11, "b", {"x": 0, "y": 0}, "pose"),
    ]
    for version, expected in (({}, ["near a+b", "old a"]), ({"version": 2}, [])):
        records = [Control(START, {**start, **version}), *arrivals, Control(at(25), {"kind": "end"})]
        outcome = replay_intake(records, None, None)
        assert [f"{event.episode.rule} {event.episode.subject}" for event in outcome.events] == expected
    changed = Control(at(2), {"kind": "rules", "detector": a_detector().to_json(), "rules": start["rules"]})
    outcome = replay_intake([Control(START, start), *arrivals[:2], changed, arrivals[2], records[-1]], None, None)
    assert [f"{event.episode.rule} {event.episode.subject}" for event in outcome.events] == ["near a+b", "old a"]
