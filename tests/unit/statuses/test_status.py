"""A running detector reports received, evaluated and lost samples; the numbers match those sent."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from detector.assembly import RefusedRule
from detector.commands.inquiry import query_selected
from detector.engine.samples.intake import Intake
from detector.engine.samples.sample import Arrival
from detector.findings.losses import Losses
from detector.live.evaluator import Evaluator
from detector.status.explaining import RuleWatch
from detector.status.model import CertificateStatus, RuleExplanation, RuleState, Status, read_status, to_json
from detector.status.table import status_view
from detector.status.updating import StatusUpdater
from detector.streams.query_handler import NoAnswerError, QueryHandler, query_detectors
from detector.streams.zenoh import Network
from tests.driving import POSITION, Drive, a_detector, a_rule, a_stream, arrival, at
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.rules import RuleProblem

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}
FAST = a_rule("fast", signals=[SPEED], when="v > 10")


class ObservedEngine:
    """An engine, its status, and the wall clock."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.time = 0.0
        self.updater = StatusUpdater(drive.engine, Losses(drive.engine), lambda: at(self.time))

    def take(self, *arrivals: object, until: float) -> Status:
        self.updater.arrived(arrivals)  # type: ignore[arg-type]
        self.drive.take(*arrivals, until=until)  # type: ignore[arg-type]
        self.time = until
        self.updater.cycle_finished()
        return self.updater.latest


def test_streams_are_reported_with_rate_age_buffer_and_latency() -> None:
    stamped = a_stream("speed", stamp="msg.t")
    kept = ObservedEngine(Drive(a_detector(a_stream("pose"), stamped), FAST))
    for second in range(10):
        sent = arrival(second + 0.5, "car", {"v": 1, "t": at(second + 0.5) / 1e9 - 0.03})
        status = kept.take(sent, until=second + 1)
    pose, speed = status.streams
    assert (pose.name, pose.samples, pose.rate, pose.age, pose.clients) == ("pose", 0, 0.0, None, 0)
    assert (speed.samples, speed.rate, speed.age, speed.clients) == (10, 1.0, 0.5, 1)
    lane = kept.drive.engine.buffer.lane("car", "speed")
    assert lane is not None
    assert (speed.buffered_samples, speed.buffered_bytes) == (len(lane.samples), lane.bytes)
    assert status.buffered_bytes == lane.bytes
    assert speed.latency.count == 10
    assert speed.latency.quantile(0.5) == 0.05
    assert [(client.name, client.age) for client in status.clients] == [("car", 0.5)]


def test_rules_are_reported_with_unknowns_errors_and_open_episodes() -> None:
    kept = ObservedEngine(Drive(a_detector(), FAST))
    status = kept.take(arrival(0.5, "car", {"v": 20}), arrival(0.6, "bus", {}), until=1)
    (rule,) = status.rules
    assert (rule.state, rule.evaluations, rule.ticks, rule.started, rule.open) == (RuleState.ACCEPTED, 2, 1, 1, 1)
    assert rule.unknowns > 0
    assert rule.latency is not None
    assert rule.latency.count == 2  # of two clients, half a second old
    assert rule.latency.sum == pytest.approx(0.5 + 0.4)


def test_the_latency_of_a_rule_counts_a_sample_once_before_a_long_silence() -> None:
    kept = ObservedEngine(Drive(a_detector(), FAST))
    kept.take(arrival(0.5, "car", {"v": 20}), until=1)
    for second in range(2, 20):
        status = kept.take(until=second)
    status = kept.take(arrival(19.5, "bus", {"v": 20}), arrival(19.75, "car", {"v": 20}), until=20)
    (rule,) = status.rules
    assert rule.latency is not None
    assert rule.latency.count == 3
    assert rule.latency.sum == pytest.approx(0.5 + 0.5 + 0.25)


def test_silent_clients_leave_room_for_the_latencies_of_others() -> None:
    kept = ObservedEngine(Drive(a_detector(), FAST))
    kept.take(*(arrival(0.5, f"a{n}", {"v": 20}) for n in range(20)), until=1)
    status = kept.take(arrival(1.5, "z", {"v": 20}), until=2)
    assert status.rules[0].latency is not None
    assert status.rules[0].latency.count == 16 + 1


def test_the_latency_of_a_rule_ends_with_its_evaluation_and_not_with_a_later_look() -> None:
    kept = ObservedEngine(Drive(a_detector(), FAST))
    for tick in range(1, 11):  # after each tick, a second look in which nothing is evaluated
        kept.take(arrival(tick - 0.5, "car", {"v": 20}), until=tick + 0.01 / tick)
        status = kept.take(until=tick + 0.4)
    assert status.rules[0].latency is not None
    assert status.rules[0].latency.count == 10
    assert status.rules[0].latency.sum == pytest.approx(10 * 0.5, abs=0.05)


def test_with_clock_data_latencies_are_from_the_stamp_to_the_receipt() -> None:
    kept = ObservedEngine(Drive(a_detector(a_stream("speed", stamp="msg.t"), clock="Data"), FAST))
    kept.take(arrival(100.0, "car", {"v": 1, "t": 1_767_225_600.0}), until=100)
    status = kept.take(arrival(101.25, "car", {"v": 1, "t": 1_767_225_601.0}), until=102)
    assert status.streams[0].latency.sum == pytest.approx(100 + 100.25)


def test_a_rule_that_is_refused_or_disabled_reports_it() -> None:
    kept = ObservedEngine(Drive(a_detector(), a_rule("off", when="true", enabled=False)))
    kept.updater.refused(
        [RefusedRule(a_rule("bad", when="1"), (RuleProblem(("spec", "when"), "no boolean"),), kept=False)]
    )
    status = kept.take(until=1)
    assert [(rule.name, rule.state) for rule in status.rules] == [
        ("bad", RuleState.REFUSED),
        ("off", RuleState.DISABLED),
    ]
    assert status.rules[0].message == "EventRule bad is refused: spec.when: no boolean"


def test_drops_are_reported_by_cause() -> None:
    kept = ObservedEngine(Drive(a_detector(), a_rule("r", signals=[SPEED], when="v > 1")))
    status = kept.take(arrival(0.5, "car", b"{"), arrival(0.6, "c%", {}), until=1)
    drops = {(drop.cause, drop.stream): drop.count for drop in status.drops if drop.count}
    assert drops == {("undecodable", "speed"): 1, ("unnamed", "speed"): 1}


def test_a_status_is_taken_at_most_once_a_second_and_round_trips() -> None:
    kept = ObservedEngine(Drive(a_detector(), FAST))
    first = kept.take(arrival(0.5, "car", {"v": 20}), until=1)
    assert kept.take(until=1.9) is first
    second = kept.take(until=2)
    assert second.taken == first.taken + 1
    assert read_status(to_json(second)) == second
    assert status_view(second) is not None


class _NullSink:
    def events(self, events: object) -> None: ...

    def consequences(self, consequences: object) -> None: ...

    def demands(self, demands: object, ended: object) -> None: ...


def test_calls_run_on_the_evaluation_thread_and_raise_in_the_caller() -> None:
    failures: list[BaseException] = []
    drive = Drive(a_detector())
    evaluator = Evaluator(
        drive.engine, Intake(lambda: at(0)), _NullSink(), now=lambda: at(0), on_failure=failures.append
    )
    early = evaluator.call(lambda: drive.engine.now)
    evaluator._thread.start()
    assert early.result(PATIENCE) == drive.engine.now
    with pytest.raises(ZeroDivisionError):
        evaluator.call(lambda: 1 // 0).result(PATIENCE)
    assert evaluator.call(lambda: "continues").result(PATIENCE) == "continues"
    evaluator.stop()
    assert evaluator.call(lambda: "too late").cancelled()
    assert failures == []


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def an_answer(what: str, given: object, payload: bytes) -> bytes:
    if what == "status":
        return f'{{"given": "{given}"}}'.encode()
    raise ValueError(f"does not answer {what!r}")


@pytest.fixture
def answering(endpoint: str) -> Iterator[None]:
    network = Network(
        Zenoh(listen=[endpoint]),
        [],
        lambda stream: print,
        make_query_handler=lambda session: QueryHandler(session, "d", an_answer),
    )
    network.start()
    yield
    network.close()


@pytest.mark.usefixtures("answering")
def test_queries_reach_one_or_all_detectors_and_errors_are_returned(endpoint: str) -> None:
    config = Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint])
    for holder in ("d", "*"):
        (answer,) = query_detectors(config, holder, "status", {"rule": "r", "subject": "a+b~c"}, 30)
        assert answer.key == "wayside/detectors/d/status"
        assert b"'rule': 'r', 'subject': 'a+b~c'" in answer.payload
    with pytest.raises(NoAnswerError, match="does not answer 'nonsense'"):
        query_detectors(config, "d", "nonsense", {}, 30)
    with pytest.raises(NoAnswerError, match=r"no response from detector other at tcp/.* within 0.5 s: is it running"):
        query_detectors(config, "other", "status", {}, 0.5)


@pytest.mark.usefixtures("answering")
def test_the_detectors_file_has_its_listen_endpoints(endpoint: str, tmp_path: Path) -> None:
    file = tmp_path / "detector.yaml"
    file.write_text(a_detector(zenoh={"listen": [endpoint]}).model_dump_json(by_alias=True, exclude_none=True))
    (answer,) = query_selected("status", {}, file, None, None, 30)
    assert answer.key == "wayside/detectors/d/status"


def explained(
    drive: Drive, rule: str, subject: str | None = None, *, until: float, sent: Sequence[Arrival] = ()
) -> RuleExplanation:
    watching = RuleWatch(drive.engine, rule, subject)
    assert not watching.is_over()
    drive.take(*sent, until=until)
    assert watching.is_over()
    return watching.future.result(0)


def test_an_explained_evaluation_reports_values_and_reasons_of_unknowns() -> None:
    gap = {"name": "gap", "stream": "pose", "value": "msg.gap"}
    rule = a_rule("r", signals=[SPEED, gap], when="v > 10 && gap < 5", **{"for": "2s"})
    drive = Drive(a_detector(a_stream("pose", staleAfter="2s"), a_stream("speed")), rule)
    sent = [arrival(0.1, "a", {"v": 20}), arrival(0.2, "a", {"gap": 1}, "pose"), arrival(0.3, "b", {"v": 20})]
    found = {each.subject: each for each in explained(drive, "r", until=1, sent=sent).subjects}
    assert (found["a"].when, found["a"].pending, found["a"].open, found["a"].values) == (
        True,
        0.0,
        False,
        {"v": 20.0, "gap": 1.0},
    )
    assert found["b"].when is None
    assert found["b"].unknown == {"gap": "no sample of stream pose has arrived from b"}
    drive.take(until=2)
    (later,) = explained(drive, "r", "a", until=3).subjects
    assert later.unknown == {"gap": "stream pose of a is stale: its newest sample is 2.8 s old, more than staleAfter"}
    (third,) = explained(drive, "r", "b", until=4, sent=[arrival(3.5, "b", {"other": 1}, "pose")]).subjects
    assert third.unknown == {"gap": "the samples of stream pose from b have no such value in the window"}
    assert drive.engine.rules["r"].on_evaluated is None


def test_missing_inputs_and_errors_of_expressions_are_reported() -> None:
    drive = Drive(a_detector(), a_rule("r", signals=[SPEED], when="v.x > 10"))
    explanation = explained(drive, "r", until=1, sent=[arrival(0.1, "a", {"v": 20}), arrival(0.2, "b", {})])
    assert explanation.notes == [
        'no key "v" in the map',
        "`v` is 20.0, which has no field `x`: correct the path",
        "no value for `v`",
    ]
    assert len(explanation.subjects) == 2


@pytest.mark.parametrize(
    ("subject", "why"),
    [
        ("a+b", "the pair is not within 100 m, or a position is unknown, or a role does not match"),
        ("a+nobody", "unknown client nobody: no sample arrived from it within clientTimeout"),
        ("a", "the rule is about pairs: write car1+car2"),
    ],
)
def test_a_subject_that_is_not_evaluated_is_reported_with_the_reason(subject: str, why: str) -> None:
    drive = Drive(a_detector(), a_rule("near", scope={"pairs": {"position": POSITION, "within": 100}}, when="true"))
    sent = [arrival(0.1, "a", {"x": 0, "y": 0}, "pose"), arrival(0.2, "b", {"x": 900, "y": 0}, "pose")]
    (reported,) = explained(drive, "near", subject, until=1, sent=sent).subjects
    assert not reported.evaluated
    assert reported.why == why


def test_the_signals_of_both_clients_of_a_pair_are_reported() -> None:
    scope = {"pairs": {"position": POSITION, "within": 100}}
    drive = Drive(a_detector(), a_rule("near", scope=scope, signals=[SPEED], when="a.v + b.v > 1"))
    sent = [arrival(0.1, "a", {"x": 0, "y": 0}, "pose"), arrival(0.2, "b", {"x": 9, "y": 0}, "pose")]
    (reported,) = explained(drive, "near", "a+b", until=1, sent=[*sent, arrival(0.3, "b", {"v": 3})]).subjects
    assert reported.near is True
    assert reported.unknown == {"a.v": "no sample of stream speed has arrived from a"}


def test_explanations_end_with_their_rule_and_run_one_at_a_time() -> None:
    drive = Drive(a_detector(), FAST)
    watching = RuleWatch(drive.engine, "fast", None)
    with pytest.raises(ValueError, match="another request about rule fast"):
        RuleWatch(drive.engine, "fast", None)
    drive.engine.set_rules([])
    assert watching.is_over()
    assert watching.future.result(0).subjects == []
    with pytest.raises(ValueError, match="rule fast is not evaluated"):
        RuleWatch(drive.engine, "fast", None)


def test_the_status_lists_demands_and_missing_clients() -> None:
    detector = a_detector(
        clients=[{"name": "rsu-1", "expected": True}, {"name": "rsu-2", "expected": True}], clientTimeout="4s"
    )
    kept = ObservedEngine(Drive(detector, FAST))
    kept.updater.demands = ("fast-b", "fast-a")
    status = kept.take(arrival(0.5, "rsu-1", {"v": 20}), until=1)
    assert (status.demands, status.demand_count, status.missing) == (["fast-a", "fast-b"], 2, [])
    status = kept.take(arrival(9.5, "rsu-1", {"v": 20}), until=10)
    assert (status.missing, status.missing_count) == (["rsu-2"], 1)
    shown = Console(width=160, file=io.StringIO(), record=True)
    reported = msgspec.structs.replace(
        status, certificate=CertificateStatus(expires=status.taken + 90 * 86400, renewals=2, problem="expired")
    )
    shown.print(status_view(reported))
    text = shown.export_text()
    assert "certificate expires in 90.0 days, renewed 2 times" in text
    assert "new certificates not in use: expired" in text
    assert "demands: fast-a, fast-b" in text
    assert "missing: rsu-2" in text
