"""Samples arrive from real Zenoh sessions, in order and whenever the other side appears; events go out."""

import socket
import time
from collections.abc import Iterator
from contextlib import closing

import pytest
import zenoh

from detector.streams.zenoh import EVENT_ENCODING, Network, NetworkError
from tests.networks import Arrivals, router, session, stream, wait_for
from tests.patience import PATIENCE
from wayside.api.zenoh import Zenoh, ZenohMode


@pytest.fixture
def listening(endpoint: str, arrivals: Arrivals) -> Iterator[Network]:
    network = Network(Zenoh(listen=[endpoint]), [stream(), stream("all", "**/${client:*}/pose")], arrivals.putter)
    network.start()
    yield network
    network.close()


def test_samples_arrive_in_order_on_every_stream_that_their_key_belongs_to(
    listening: Network, endpoint: str, arrivals: Arrivals
) -> None:
    with session(connect__endpoints=[endpoint]) as vehicle:
        for number in range(100):
            vehicle.put("vehicles/car1/pose", str(number), congestion_control=zenoh.CongestionControl.BLOCK)
        vehicle.put("vehicles/car1/other", "no stream's")
        arrivals.wait_for(lambda seen: len(seen) == 200)
    for name in ("pose", "all"):
        of_stream = [sample for sample in arrivals.seen if sample[0] == name]
        assert of_stream == [(name, "vehicles/car1/pose", str(number).encode()) for number in range(100)]


def test_empty_payloads_are_samples_and_deletions_are_not(
    listening: Network, endpoint: str, arrivals: Arrivals
) -> None:
    with session(connect__endpoints=[endpoint]) as vehicle:
        vehicle.delete("vehicles/car1/pose")
        vehicle.put("vehicles/car1/pose", b"")
        vehicle.put("vehicles/car1/pose", b"end")
        arrivals.wait_for(lambda seen: sum(payload == b"end" for _, _, payload in seen) == 2)
    assert [payload for name, _, payload in arrivals.seen if name == "pose"] == [b"", b"end"]


@pytest.mark.parametrize("mode", ZenohMode)
def test_data_flows_once_the_router_exists_and_again_after_it_was_away(
    mode: ZenohMode, endpoint: str, arrivals: Arrivals
) -> None:
    listen = ["tcp/127.0.0.1:0"] if mode is ZenohMode.ROUTER else []
    network = Network(Zenoh(mode=mode, connect=[endpoint], listen=listen), [stream()], arrivals.putter)
    network.start()
    assert not network.connected
    for text in (b"first", b"second"):
        with router(listen__endpoints=[endpoint]) as there:
            deadline = time.monotonic() + PATIENCE
            while not any(payload == text for _, _, payload in arrivals.seen):
                assert time.monotonic() < deadline, "nothing arrived"
                there.put("vehicles/car1/pose", text)
            wait_for(lambda: network.connected)
    network.close()


def test_events_are_published_with_their_encoding(listening: Network, endpoint: str) -> None:
    with session(connect__endpoints=[endpoint]) as listener:
        subscriber = listener.declare_subscriber("wayside/events/**")
        deadline = time.monotonic() + PATIENCE
        while (event := subscriber.try_recv()) is None:  # the first ones may be sent before the subscription is known
            assert time.monotonic() < deadline
            listening.publish("wayside/events/det/rule/car1+car2", b"{}")
        assert str(event.key_expr) == "wayside/events/det/rule/car1+car2"
        assert event.payload.to_bytes() == b"{}"
        assert str(event.encoding) == EVENT_ENCODING


def test_events_wait_for_the_router_and_those_beyond_the_capacity_are_counted(
    endpoint: str, arrivals: Arrivals
) -> None:
    network = Network(Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint]), [stream()], arrivals.putter, capacity=2)
    network.start()
    for number in range(5):
        network.publish("wayside/events/d/r/s", str(number).encode())
    assert network.dropped_events == 3
    network.close()
    assert network.dropped_events == 5


def test_closing_while_no_router_answers_is_prompt(endpoint: str, arrivals: Arrivals) -> None:
    network = Network(Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint]), [stream()], arrivals.putter)
    network.start()
    start = time.monotonic()
    network.close()
    assert time.monotonic() - start < PATIENCE / 4


def test_an_endpoint_that_cannot_be_bound_is_an_error_that_names_it(arrivals: Arrivals) -> None:
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(NetworkError, match=endpoint):
            Network(Zenoh(listen=[endpoint]), [stream()], arrivals.putter).start()
