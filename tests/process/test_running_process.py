"""A detector process over real Zenoh: its status and metrics match the sent samples, and changes lose nothing."""

from __future__ import annotations

import json
import signal
import socket
import ssl
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from detector.status.model import RuleState, Status, read_status
from detector.streams.query_handler import NoAnswerError, query_detectors
from tests import programs
from tests.certificates import Authority
from tests.driving import a_deploy, a_rule, a_stream
from tests.networks import wait_for
from tests.patience import PATIENCE
from tests.process.running import Process

SPEED = {"name": "v", "stream": "speed", "value": "msg.v", "aggregate": "Max", "over": "5m"}
FAST = a_rule("fast", signals=[SPEED], when="v > 10", evaluation={"every": "100ms"})


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    process = Process(tmp_path)
    process.write(FAST)
    process.start()
    yield process
    assert process.stop() == 0


def test_status_and_metrics_match_the_samples_sent(process: Process) -> None:
    for number in range(50):
        process.send("car1", {"v": number})
        process.send("car2", {"v": 1})
    process.send("car2", b"{")
    process.send("c%", {"v": 1})

    def dropped(status: Status) -> dict[tuple[str, str], int]:
        return {(drop.cause, drop.stream): drop.count for drop in status.drops if drop.count}

    # Unreadable samples are counted when they are evaluated; the last message names no client, so it is no sample.
    status = process.status_when(
        lambda s: s.streams[1].samples == 101 and bool(s.rules[0].open) and len(dropped(s)) == 2
    )
    assert status.connected
    assert dropped(status) == {("undecodable", "speed"): 1, ("unnamed", "speed"): 1}
    assert [client.name for client in status.clients] == ["car1", "car2"]
    metrics = process.metrics()
    assert metrics["stream_samples_total", "speed"] == 101
    (answer,) = query_detectors(
        process.network, "d", "status", {"rule": "fast", "subject": "car2", "wait": "30"}, PATIENCE
    )
    reported = read_status(answer.payload).explanation
    assert reported is not None
    assert [(each.subject, each.when, each.values) for each in reported.subjects] == [("car2", False, {"v": 1.0})]
    with pytest.raises(NoAnswerError, match="detector d has no rule slow; it has fast"):
        query_detectors(process.network, "d", "status", {"rule": "slow"}, PATIENCE)
    assert metrics["rule_episodes_open", "fast"] == 1
    assert metrics["process_resident_memory_bytes",] > 0
    assert "the last evaluation" in process.page("/healthz")
    assert "the last evaluation" in process.page("/readyz")


def test_the_tasks_that_it_created_and_ended_are_counted(process: Process) -> None:
    process.change(
        a_rule("fast", signals=[SPEED], when="v > 10", evaluation={"every": "100ms"}, actions=[a_deploy("d")])
    )
    process.send("car1", {"v": 20})
    status = process.status_when(lambda s: s.tasks.created == 1 and s.demand_count == 1)
    assert (status.tasks.ended, status.lease) == (0, None)
    process.change()
    process.status_when(lambda s: s.tasks.ended == 1)
    assert process.metrics()["task_changes_total", "created"] == process.metrics()["task_changes_total", "ended"] == 1


def test_a_rule_is_evaluated_paused_and_resumed_by_commands(process: Process) -> None:
    process.change(FAST, a_rule("on-demand", signals=[SPEED], when="v > 10", evaluation={"onDemand": True}))
    process.send("car1", {"v": 20})
    process.status_when(lambda s: len(s.rules) == 2 and s.streams[1].samples == 1)

    def command(*words: str) -> subprocess.CompletedProcess[str]:
        return programs.run(
            "detector", *words, "--detector", "detector.yaml", "--timeout", str(PATIENCE / 4), folder=process.folder
        )

    answer = json.loads(command("evaluate", "on-demand").stdout)
    assert (answer["subject"], answer["when"], answer["values"]) == ("car1", True, {"v": 20})
    refused = command("evaluate", "fast")
    assert refused.returncode == 2
    assert "rule fast is not evaluated on demand: write evaluation: {onDemand: true}" in refused.stderr
    assert command("pause", "fast").stderr == "d: rule fast paused\n"
    process.status_when(lambda s: {rule.name: rule.state for rule in s.rules}["fast"] is RuleState.PAUSED)
    assert command("resume", "fast").stderr == "d: rule fast resumed\n"
    process.status_when(lambda s: {rule.name: rule.state for rule in s.rules}["fast"] is RuleState.ACCEPTED)


def test_rules_and_streams_change_without_losing_buffer_or_episodes(process: Process) -> None:
    process.send("car1", {"v": 20})
    before = process.status_when(lambda s: bool(s.rules[0].open))
    slow = a_rule("slow", signals=[SPEED], when="v > 15", evaluation={"every": "100ms"})
    more = (a_stream("speed"), a_stream("pose"), a_stream("more"))
    process.change(FAST, slow, streams=more, clientTimeout="6m")
    # The new rule's window includes the sample that arrived before the rule existed.
    after = process.status_when(lambda s: len(s.rules) == 2 and bool(s.rules[1].open))
    assert [stream.name for stream in after.streams] == ["speed", "pose", "more"]
    assert (after.rules[0].open, after.rules[0].started) == (1, 1)
    assert after.streams[0].buffered_bytes == before.streams[1].buffered_bytes
    process.send("car1", {"v": 1}, stream="more")
    process.status_when(lambda s: s.streams[2].samples == 1)
    broken = a_rule("slow", signals=[SPEED], when="w > 15", evaluation={"every": "100ms"})
    process.change(FAST, broken, streams=more)
    refused = process.status_when(lambda s: s.rules[1].state == "Refused")
    assert refused.rules[1].open == 1
    assert "keeping its last good version" in refused.rules[1].message
    (process.folder / "rules.yaml").write_text("no: [yaml")
    process.process.send_signal(signal.SIGHUP)
    process.send("car2", {"v": 1})
    still = process.status_when(lambda s: s.streams[0].samples == 2)
    assert [rule.open for rule in still.rules] == [1, 1]
    reported = [f"{event['data']['rule']} {event['type'].rsplit('.', 1)[-1]}" for event in process.events_when(2)]
    assert reported == ["fast started", "slow started"]


def test_a_detector_that_is_stopped_evaluates_the_last_lateness_and_so_does_the_replay_of_its_intake(
    tmp_path: Path,
) -> None:
    process = Process(tmp_path)
    streams = (a_stream("speed", stamp="msg.t"),)
    sampled = a_rule(
        "sampled", signals=FAST.to_json()["spec"]["signals"], when="v > 10", evaluation={"onSample": "speed"}
    )
    process.write(FAST, sampled, streams=streams, clock="Data", lateness="5m", maxAhead="1h")
    process.start("--output", "out", "--record-intake", "intake.mcap")
    for number in (1, 2):  # a status has the receive time of one sample each second
        process.send("car1", {"t": 1_000 + number / 2, "v": 20})
        process.status_when(lambda s, number=number: s.streams[0].latency.count == number)  # type: ignore[misc]
    assert process.written() == []
    assert process.stop() == 0
    live = (tmp_path / "out" / "events.jsonl").read_bytes()
    programs.run("detector", "replay", "intake.mcap", "--output", "replayed", folder=tmp_path, check=True)
    assert (tmp_path / "replayed" / "events.jsonl").read_bytes() == live
    assert [f"{event['data']['rule']} {event['time']}" for event in map(json.loads, live.splitlines())] == [
        "fast 1970-01-01T00:16:40.500000000Z",
        "sampled 1970-01-01T00:16:40.500000000Z",
    ]


def test_metrics_and_health_by_tls_follow_a_renewed_certificate(tmp_path: Path) -> None:
    first, second = (Authority(tmp_path, name) for name in ("first", "second"))
    first.mount(mounted := tmp_path / "certificates", "detector")
    process = Process(tmp_path)
    process.write(FAST)
    process.start("--metrics-certificates", str(mounted))

    def shown(path: str, authority: Authority) -> str:
        """The page for a client that trusts this authority; empty if it did not sign the certificate."""
        trusting = ssl.create_default_context(cafile=authority.ca)
        try:
            with urllib.request.urlopen(f"https://localhost:{process.port}{path}", context=trusting) as answer:
                return str(answer.read().decode())
        except urllib.error.URLError as error:
            if not isinstance(error.reason, ssl.SSLCertVerificationError):
                raise
            return ""

    assert "wayside_detector_info" in shown("/metrics", first)
    assert not shown("/metrics", second)
    with pytest.raises(OSError, match=r"Remote end closed|reset"):
        process.page("/metrics")  # without TLS
    with socket.create_connection(("127.0.0.1", process.port)):  # a client without a handshake blocks no other client
        assert shown("/healthz", first)
    broken = {"tls.crt": b"none", "tls.key": b"none"}
    first.change(mounted, broken)
    log = tmp_path / "log"
    wait_for(lambda: "--metrics-certificates: tls.crt and tls.key are not a certificate and a key" in log.read_text())
    assert shown("/healthz", first), "the previous certificate is kept"
    second.mount(mounted, "detector")
    wait_for(lambda: bool(shown("/healthz", second)))
    assert not shown("/healthz", first)
    assert process.stop() == 0
    assert "Traceback" not in log.read_text()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--metrics-certificates", "."], "--metrics-certificates requires --metrics-port"),
        (
            ["--metrics-port", "0", "--metrics-certificates", "."],
            "tls.crt: No such file or directory: the folder must contain",
        ),
    ],
)
def test_unusable_metrics_certificates_are_an_error(options: list[str], problem: str, tmp_path: Path) -> None:
    Process(tmp_path).write(FAST)
    files = ["--detector", "detector.yaml", "--rules", "rules.yaml"]
    done = programs.run("detector", "run", *files, *options, folder=tmp_path)
    assert done.returncode == 2
    assert problem in " ".join(done.stderr.replace("│", " ").split())
