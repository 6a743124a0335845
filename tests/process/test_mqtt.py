"""The mqtt source over a real broker: topics become keys, and the source reconnects to a restarted broker."""

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import Client

from detector.sources.mqtt import topic_filter
from detector.sources.supervision import SourceState, SourceThread
from detector.streams.loss_counter import Cause, LossCounter
from tests.certificates import Authority
from tests.networks import Arrivals, stream, wait_for
from tests.patience import PATIENCE
from tests.ports import free_port
from tests.process.mqtt_broker import PASSWORD, broker, publisher
from wayside.api.plugin import DataSource


@pytest.fixture
def port() -> int:
    return free_port()


@contextmanager
def mqtt(
    arrivals: Arrivals, loss_counter: LossCounter, *, key: str = "vehicles/${client:*}/pose", **parameters: Any
) -> Iterator[SourceThread]:
    source = DataSource(name="broker", plugin="mqtt", parameters={"host": "localhost", **parameters})
    thread = SourceThread(
        source, (stream(key=key, source="broker"),), arrivals.putter, loss_counter, first_pause=0.1, longest_pause=0.5
    )
    thread.start()
    try:
        yield thread
    finally:
        thread.request_stop()
        thread.join(PATIENCE)
    assert thread.state is SourceState.STOPPED


def publish_until(client: Client, topic: str, done: Callable[[], object]) -> None:
    """The first messages may be sent before the subscription exists."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        client.publish(topic, b"{}")
        time.sleep(0.02)


def test_messages_arrive_on_their_keys_also_after_the_broker_was_killed(port: int, arrivals: Arrivals) -> None:
    loss_counter = LossCounter()
    with mqtt(arrivals, loss_counter, port=port) as thread:
        for client in ("car1", "car2"):  # no broker runs yet
            wait_for(lambda: thread.state is SourceState.PAUSING)
            with broker(port), publisher(port) as sender:
                publish_until(sender, f"vehicles/{client}/pose", lambda: client in str(arrivals.seen))  # noqa: B023
    assert set(arrivals.seen) == {("pose", "vehicles/car1/pose", b"{}"), ("pose", "vehicles/car2/pose", b"{}")}
    failures = [entry for entry in loss_counter.entries() if entry.cause is Cause.FAILED]
    assert [entry.name for entry in failures] == ["broker"]
    assert failures[0].count >= 2


def test_the_topic_prefix_is_removed_and_other_topics_are_dropped(port: int, arrivals: Arrivals) -> None:
    loss_counter = LossCounter()
    with (
        broker(port),
        publisher(port) as client,
        mqtt(arrivals, loss_counter, port=port, prefix="/site/", key="v/${client:car$*}/pose"),
    ):
        publish_until(client, "/site/v/bike1/pose", loss_counter.entries)
        publish_until(client, "/site/v/car1/pose", lambda: arrivals.seen)
    assert {key for _, key, _ in arrivals.seen} == {"v/car1/pose"}
    assert [(entry.cause, entry.last) for entry in loss_counter.entries()] == [(Cause.UNROUTED, "v/bike1/pose")]


def test_over_tls_with_a_password(
    port: int, arrivals: Arrivals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    authority = Authority(tmp_path)
    certificate, key = authority.sign("broker")
    given = {
        "port": port,
        "tls": {"ca": str(authority.ca)},
        "credentials": {"username": "detector", "passwordVariable": "MQTT_PASSWORD"},
    }
    with broker(port, guarded=True, ssl=True, certfile=str(certificate), keyfile=str(key)):
        with mqtt(arrivals, LossCounter(), **given) as thread:
            wait_for(lambda: "MQTT_PASSWORD is not set" in thread.last_error)
            monkeypatch.setenv("MQTT_PASSWORD", "close sesame")
            wait_for(lambda: "refused the connection" in thread.last_error)
            monkeypatch.setenv("MQTT_PASSWORD", PASSWORD)
            with publisher(port, str(authority.ca)) as client:
                publish_until(client, "vehicles/car1/pose", lambda: arrivals.seen)
        stranger = Authority(tmp_path, "stranger")
        with mqtt(arrivals, LossCounter(), **{**given, "tls": {"ca": str(stranger.ca)}}) as thread:
            wait_for(lambda: "certificate verify failed" in thread.last_error)
    assert "sesame" not in caplog.text


def test_with_a_client_id_the_broker_keeps_messages_while_the_detector_is_away(
    port: int, arrivals: Arrivals, tmp_path: Path
) -> None:
    (tmp_path / "password").write_text(PASSWORD + "\n")
    credentials = {"username": "detector", "passwordFile": str(tmp_path / "password")}
    given = {"port": port, "clientId": "detector", "qos": 1, "credentials": credentials}
    with broker(port, guarded=True), publisher(port) as client:  # this broker keeps no messages for unnamed clients
        with mqtt(arrivals, LossCounter(), **given):
            publish_until(client, "vehicles/car1/pose", lambda: arrivals.seen)
        # Until the broker notices the detector's disconnection, it sends messages to the old connection: they are lost.
        for number in itertools.count():
            client.publish("vehicles/car1/pose", b"meanwhile", qos=1).wait_for_publish(PATIENCE)
            with mqtt(arrivals, LossCounter(), **given):
                came = arrivals.comes(lambda seen: any(payload == b"meanwhile" for _, _, payload in seen), 5.0)
            if came or number == 9:
                break
        assert came, arrivals.seen


@pytest.mark.parametrize(
    ("expression", "topic"),
    [
        ("vehicles/*/pose", "vehicles/+/pose"),
        ("vehicles/car$*/pose", "vehicles/+/pose"),
        ("vehicles/**", "vehicles/#"),
        ("**/pose", "#"),
    ],
)
def test_a_key_expression_as_a_topic_filter(expression: str, topic: str) -> None:
    assert topic_filter(expression) == topic
