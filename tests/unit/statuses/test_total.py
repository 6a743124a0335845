"""`detector status --all`: the sum of several detectors is the sum of what each of them counts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from detector.commands.cli import app
from detector.engine.samples.sample import Arrival
from detector.status.model import Drops, RuleState, Status, read_status, to_json
from detector.status.total import Total, total
from detector.streams.query_handler import NoAnswerError, QueryHandler
from detector.streams.zenoh import Network
from tests.driving import Drive, a_detector, a_rule, arrival
from tests.ports import free_endpoint
from tests.unit.statuses.test_status import FAST, ObservedEngine
from wayside.api.documents import DocumentError
from wayside.api.zenoh import Zenoh


def status(holder: str, *arrivals: Arrival, until: float = 2) -> Status:
    kept = ObservedEngine(Drive(a_detector(), FAST, a_rule("slow", signals=[], when="false")))
    return msgspec.structs.replace(kept.take(*arrivals, until=until), holder=holder)


@pytest.fixture(scope="module")
def north() -> Status:
    """Of two cars, of which one is fast."""
    return status("north", arrival(0.5, "car1", {"v": 20}), arrival(0.7, "car2", {"v": 1}))


@pytest.fixture(scope="module")
def center() -> Status:
    """Of one of these cars and a third one: both fast."""
    return status("center", arrival(0.9, "car2", {"v": 20}), arrival(1.5, "car3", {"v": 20}))


def test_counts_are_added_and_a_client_of_both_is_named(north: Status, center: Status) -> None:
    added = total([north, center])
    assert [each.holder for each in added.detectors] == ["center", "north"]
    assert (added.client_count, added.shared_clients, added.clients_complete) == (4, ["car2"], True)
    (speed,) = (each for each in added.streams if each.name == "speed")
    assert (speed.samples, speed.clients, speed.age) == (4, 4, 0.5)
    assert speed.buffered_bytes == sum(it.buffered_bytes for each in (north, center) for it in each.streams)
    rules = {each.name: each for each in added.rules}
    assert (rules["fast"].started, rules["fast"].open, rules["slow"].started) == (3, 3, 0)
    assert rules["fast"].evaluations == north.rules[0].evaluations + center.rules[0].evaluations
    assert rules["fast"].latency is not None
    assert rules["fast"].latency.count == sum(
        it.rules[0].latency.count for it in (north, center) if it.rules[0].latency
    )
    assert total([center, north]) == added, "whatever the order of the answers"


def test_the_worst_state_of_a_rule_is_shown_with_its_detectors(north: Status, center: Status) -> None:
    refused = msgspec.structs.replace(
        center,
        rules=[msgspec.structs.replace(center.rules[0], state=RuleState.REFUSED, message="spec.when: no boolean")],
    )
    (fast, slow) = total([north, refused]).rules
    assert (fast.state, fast.message) == (RuleState.REFUSED, "Refused at center: spec.when: no boolean")
    assert (slow.state, slow.message) == (RuleState.ACCEPTED, "")


def test_losses_are_joined_by_cause_and_their_reasons_name_the_detector(north: Status, center: Status) -> None:
    lost = [
        msgspec.structs.replace(each, drops=[Drops("decode", "payloads", count, "speed", last=reason)])
        for each, count, reason in ((north, 2, "no JSON"), (center, 3, ""))
    ]
    (drops,) = total(lost).drops
    assert (drops.count, drops.last) == (5, "north: no JSON")


def test_a_truncated_list_of_clients_gives_a_lower_bound(north: Status, center: Status) -> None:
    cut = msgspec.structs.replace(center, clients=center.clients[:1], client_count=7)
    added = total([north, cut])
    assert (added.client_count, added.shared_client_count, added.clients_complete) == (9, 1, False)


class Answers:
    """Detectors at an endpoint of their own each, and a file that names them."""

    def __init__(self, folder: Path, *statuses: Status) -> None:
        self.file = folder / "detectors.yaml"
        self.networks: list[Network] = []
        self.documents: list[str] = []
        for each in statuses:
            self.add(each.holder, to_json(each))

    def add(self, holder: str, payload: bytes | None) -> None:
        """A detector of the file; without a payload it does not run."""
        endpoint = free_endpoint()
        named = a_detector(zenoh={"listen": [endpoint]}).to_json() | {"metadata": {"name": holder}}
        self.documents.append(json.dumps(named))
        self.file.write_text("\n---\n".join(self.documents))
        if payload is not None:
            network = Network(
                Zenoh(listen=[endpoint]),
                [],
                lambda stream: print,
                make_query_handler=lambda session: QueryHandler(session, holder, lambda *_: payload),
            )
            network.start()
            self.networks.append(network)


@pytest.fixture
def answers(tmp_path: Path, north: Status, center: Status) -> Iterator[Answers]:
    made = Answers(tmp_path, north, center)
    yield made
    for each in made.networks:
        each.close()


def requested(*options: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["status", "--all", *options])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, done.stderr


def test_the_command_adds_up_the_detectors_of_a_file_each_in_its_own_network(
    answers: Answers, north: Status, center: Status
) -> None:
    code, text, _ = requested("--detector", str(answers.file), "--json", "--timeout", "60")
    expected = total([read_status(to_json(each)) for each in (north, center)])
    assert (code, msgspec.json.decode(text, type=Total)) == (0, expected)
    code, text, _ = requested("--detector", str(answers.file), "--rule", "fast", "--timeout", "60")
    assert code == 0
    assert "2 detectors, 4 clients (1 of them known to several detectors)" in text
    assert "known to several detectors: car2" in text
    assert "fast" in text
    assert "slow" not in text


def test_a_detector_that_does_not_answer_is_an_error_beside_the_sum_of_the_others(answers: Answers) -> None:
    answers.add("south", None)
    code, text, errors = requested("--detector", str(answers.file), "--json", "--timeout", "2")
    assert code == 1
    assert "south is not in the totals: zenoh: cannot open a session" in errors
    added = msgspec.json.decode(text, type=Total)
    assert ([each.holder for each in added.detectors], added.missing_detectors) == (["center", "north"], ["south"])


def test_statuses_that_cannot_be_added_are_rejected_with_the_remedy(answers: Answers, tmp_path: Path) -> None:
    file = str(answers.file)
    for options, error in (
        (("--name", "north"), "remove --name"),
        (("--rule", "fast", "--subject", "car1"), "remove --subject"),
        (
            ("--detector", file, "--rule", "fats", "--timeout", "60"),
            "no detector has this rule; the rules are fast, slow",
        ),
    ):
        code, _, errors = requested(*options)
        assert code == 2
        assert error in " ".join(errors.replace("│", " ").split())
    for each in answers.networks:
        each.close()
    with pytest.raises(NoAnswerError, match=r"no detector answers: north: zenoh.*center: zenoh"):
        requested("--detector", file, "--timeout", "0.5")
    (tmp_path / "none.yaml").write_text("")
    with pytest.raises(DocumentError, match="contains no Detector"):
        requested("--detector", str(tmp_path / "none.yaml"))
