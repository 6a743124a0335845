"""The history of Advanced Publishers is requested, and lost samples are requested again, and counted."""

import re
import time

import pytest
import zenoh
from zenoh import ext

from detector.assembly import DetectorError, stream_readers
from detector.streams.loss_counter import Cause, LossCounter
from detector.streams.zenoh import Network
from tests.driving import a_detector, a_stream
from tests.networks import Arrivals, router, session, stream, wait_for
from tests.patience import PATIENCE
from wayside.api.base import PositiveDuration
from wayside.api.stream import History, Stream
from wayside.api.zenoh import Zenoh, ZenohMode

KEY = "vehicles/car1/pose"

LOSSY = [{"messages": ["put"], "flows": ["egress"], "rules": [{"key_expr": "vehicles/**", "freq": 4.0}]}]
"""The router forwards only this number of samples a second."""


def network(endpoint: str, arrivals: Arrivals, loss_counter: LossCounter, streams: list[Stream]) -> Network:
    running = Network(
        Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint]), streams, arrivals.putter, loss_counter=loss_counter
    )
    running.start()
    wait_for(lambda: running.connected)
    return running


def remembering(session: zenoh.Session) -> ext.AdvancedPublisher:
    return ext.declare_advanced_publisher(
        session,
        KEY,
        cache=ext.CacheConfig(100),
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=0.1, sporadic_heartbeat=None),
        publisher_detection=True,
    )


def test_a_late_joiner_gets_the_history_that_it_requests(endpoint: str, arrivals: Arrivals) -> None:
    streams = [
        stream("none"),
        stream("newest", history=History(samples=3)),
        stream("young", history=History(age=PositiveDuration("1h"))),
        stream("all", history=History()),
    ]
    with router(listen__endpoints=[endpoint]) as there:
        publisher = remembering(there)
        for number in range(10):
            publisher.put(str(number))
        running = network(endpoint, arrivals, LossCounter(), streams)
        arrivals.wait_for(lambda seen: len(seen) >= 23)
        publisher.put("10")
        arrivals.wait_for(lambda seen: sum(payload == b"10" for _, _, payload in seen) == 4)
        running.close()
    payloads = {
        each.name: [int(payload) for name, _, payload in arrivals.seen if name == each.name] for each in streams
    }
    assert payloads == {"none": [10], "newest": [7, 8, 9, 10], "young": [*range(11)], "all": [*range(11)]}


def test_samples_lost_in_transit_are_counted_or_requested_again(endpoint: str, arrivals: Arrivals) -> None:
    loss_counter = LossCounter()
    streams = [stream("counted", history=History(samples=1)), stream("recovered", recover=True)]
    with router(listen__endpoints=[endpoint], downsampling=LOSSY):
        running = network(endpoint, arrivals, loss_counter, streams)
        with session(connect__endpoints=[endpoint]) as vehicle:
            publisher = remembering(vehicle)
            deadline, number = time.monotonic() + PATIENCE, 0
            while not loss_counter.entries():
                assert time.monotonic() < deadline
                publisher.put(str(number))
                number += 1
                time.sleep(0.01)
            arrivals.wait_for(lambda seen: sum(name == "recovered" for name, _, _ in seen) == number)
        running.close()
    recovered = [int(payload) for name, _, payload in arrivals.seen if name == "recovered"]
    counted = [int(payload) for name, _, payload in arrivals.seen if name == "counted"]
    assert recovered == [*range(number)]
    (entry,) = loss_counter.entries()
    assert (entry.cause, entry.name) == (Cause.MISSED, "counted")
    assert entry.count == counted[-1] - counted[0] + 1 - len(counted)


def test_history_is_for_streams_over_zenoh() -> None:
    detector = a_detector(
        a_stream("pose", source="broker", history={}),
        a_stream("speed", source="broker", recover=True),
        sources=[{"name": "broker", "plugin": "mqtt"}],
    )
    with pytest.raises(
        DetectorError, match=re.escape("spec.streams[0].history: is valid only for streams over Zenoh")
    ) as caught:
        stream_readers(detector)
    assert "spec.streams[1].recover: is valid only for streams over Zenoh" in str(caught.value)
