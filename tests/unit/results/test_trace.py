"""The trace of a replay has the values and conditions that the engine used."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from detector.engine.engine import Engine
from detector.engine.samples.sample import Arrival
from detector.replay.replaying import ReplayResult, replay_arrivals
from detector.results.series import AWAY, TRUE, UNKNOWN, SubjectTrace, Trace
from detector.results.tracing import Tracer
from tests.driving import a_detector, a_rule, a_stream
from tests.unit.results.drives import SECOND, SILENT, START, arrivals, documents, messages


class OneByOne(Tracer):
    """Looks at every rule by itself, so none is evaluated in columns."""

    def attend(self, engine: Engine) -> None:
        super().attend(engine)
        for name, run in engine.rules.items():
            run.on_evaluated = self._recorded.setdefault(name, self._recorder_of(run.rule)).record

    def _recorder_of(self, rule: object) -> object:
        from detector.results.recorded_values import RecordedValues

        return RecordedValues(rule)  # type: ignore[arg-type]


def replayed(folder: Path, tracer: Tracer, batches: Sequence[Sequence[Arrival]] | None = None) -> ReplayResult:
    detector, rules = documents(folder)
    return replay_arrivals(batches or [arrivals()], detector, rules, observer=tracer)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[ReplayResult, Trace]:
    tracer = Tracer()
    outcome = replayed(tmp_path_factory.mktemp("trace"), tracer)
    return outcome, tracer.trace()


def subject(trace: Trace, rule: str, name: str) -> SubjectTrace:
    return next(each for each in trace.subjects if (each.rule, each.subject) == (rule, name))


def test_the_values_at_the_start_of_an_episode_are_those_of_its_event(seen: tuple[ReplayResult, Trace]) -> None:
    outcome, trace = seen
    started = [event for event in outcome.events if event.started]
    assert {event.episode.rule for event in started} == {"too-fast", "harsh", "close", "slow-one"}
    for event in started:
        found = subject(trace, event.episode.rule, event.episode.subject)
        time = np.array([event.episode.start_time])
        for name, value in event.values.items():
            if name in found.signals:
                series = found.signals[name]
                assert series.plain(float(series.at(time)[0])) == value
        assert found.conditions["when"].at(np.array([event.episode.onset_time])).tolist() == [TRUE]


def test_a_condition_changes_at_the_tick_at_which_an_episode_starts_or_ends(seen: tuple[ReplayResult, Trace]) -> None:
    outcome, trace = seen
    for event in outcome.events:
        conditions = subject(trace, event.episode.rule, event.episode.subject).conditions
        if event.started:
            assert event.episode.onset_time in conditions["when"].times
        elif "until" in conditions:
            assert event.end_time in conditions["until"].times
        else:
            assert event.end_time in conditions["when"].times


def test_an_unknown_stretch_begins_when_the_stream_is_stale_and_has_its_reason(
    seen: tuple[ReplayResult, Trace],
) -> None:
    when = subject(seen[1], "too-fast", "car2").conditions["when"]
    at = int(np.flatnonzero(when.codes == UNKNOWN)[0])
    begin = (int(when.times[at]) - START) / SECOND
    assert begin == pytest.approx(SILENT[0] + 1.1)
    assert when.reasons[at] == "speed: stream odom is stale: its newest sample is 1.1 s old"
    assert (int(when.times[at + 1]) - START) / SECOND == SILENT[1]


def test_a_pair_out_of_reach_has_no_distance(seen: tuple[ReplayResult, Trace]) -> None:
    pairs = [each for each in seen[1].subjects if each.rule == "close"]
    away = [each for each in pairs if (each.conditions["when"].codes == AWAY).any()]
    assert away
    for each in away:
        when = each.conditions["when"]
        times = when.times[when.codes == AWAY]
        assert np.isnan(each.signals["distance"].at(times)).all()


def test_the_batch_size_does_not_matter(tmp_path: Path, seen: tuple[ReplayResult, Trace]) -> None:
    chance = random.Random(7)

    def cut() -> Iterator[list[Arrival]]:
        rest = arrivals()
        while rest:
            size = chance.randint(1, 200)
            yield rest[:size]
            rest = rest[size:]

    tracer = Tracer()
    outcome = replayed(tmp_path, tracer, [*cut()])
    assert [event.to_json() for event in outcome.events] == [event.to_json() for event in seen[0].events]
    assert_alike(tracer.trace(), seen[1])


def test_column_and_single_evaluation_give_the_same_trace(tmp_path: Path, seen: tuple[ReplayResult, Trace]) -> None:
    tracer = OneByOne()
    replayed(tmp_path, tracer)
    alone = tracer.trace()
    for found in seen[1].subjects:
        if found.rule == "close":
            continue  # of pairs, the columns also know who is away
        other = subject(alone, found.rule, found.subject)
        assert found.signals.keys() == other.signals.keys()
        for field, steps in found.conditions.items():
            assert steps.times.tolist() == other.conditions[field].times.tolist()
            assert steps.codes.tolist() == other.conditions[field].codes.tolist()
        times = np.arange(seen[1].begin, seen[1].end, SECOND // 10)
        for name, series in found.signals.items():
            mine = [series.plain(value) for value in series.at(times).tolist()]
            assert mine == [other.signals[name].plain(value) for value in other.signals[name].at(times).tolist()]


def test_tracing_does_not_change_events(tmp_path: Path, seen: tuple[ReplayResult, Trace]) -> None:
    detector, rules = documents(tmp_path)
    plain = replay_arrivals([arrivals()], detector, rules)
    assert [event.to_json() for event in plain.events] == [event.to_json() for event in seen[0].events]


def assert_alike(one: Trace, other: Trace) -> None:
    assert [(each.rule, each.subject) for each in one.subjects] == [(e.rule, e.subject) for e in other.subjects]
    for mine, theirs in zip(one.subjects, other.subjects, strict=True):
        assert mine.signals.keys() == theirs.signals.keys()
        for name, series in mine.signals.items():
            assert series.times.tolist() == theirs.signals[name].times.tolist()
            assert np.array_equal(series.values, theirs.signals[name].values, equal_nan=True)
        for field, steps in mine.conditions.items():
            assert steps.times.tolist() == theirs.conditions[field].times.tolist()
            assert steps.codes.tolist() == theirs.conditions[field].codes.tolist()
            assert steps.reasons == theirs.conditions[field].reasons
    assert one.paths.keys() == other.paths.keys()


def test_without_a_pairs_rule_the_paths_are_the_signals_x_and_y() -> None:
    stream = a_stream("odom", staleAfter="2s")
    signals = [{"name": axis, "stream": "odom", "value": f"msg.{axis}"} for axis in ("x", "y")]
    rule = a_rule("far", signals=signals, when="x > 100", evaluation={"every": "100ms"})
    tracer = Tracer()
    replay_arrivals([arrivals()], a_detector(stream), [rule], observer=tracer)
    trace = tracer.trace()
    assert trace.paths.keys() == {"car0", "car1", "car2"}
    assert not trace.geographic
    sent = {(key.split("/")[1], message["x"], message["y"]) for _, key, message in messages()}
    for client, path in trace.paths.items():
        assert len(path.times) > 100
        assert {(client, x, y) for x, y in path.axes.T.tolist()} <= sent
