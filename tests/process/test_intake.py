"""The intake: one order for all streams and producers, without blocking."""

from __future__ import annotations

import itertools
import threading
import time

from detector.engine.samples.intake import Intake
from detector.engine.samples.sample import SAMPLE_OVERHEAD, Arrival
from tests.patience import PATIENCE


class Clock:
    """A clock that the test sets; it may stop and go back."""

    def __init__(self, now: int) -> None:
        self.now = now

    def __call__(self) -> int:
        return self.now


def test_concurrent_producers_get_monotonic_receive_times_in_queue_order() -> None:
    intake = Intake(time.time_ns)
    begin = threading.Barrier(8)

    def publish(stream: str) -> None:
        put = intake.putter(stream)
        begin.wait()
        for number in range(2_000):
            put([(f"k/{number}", b"x")])

    threads = [threading.Thread(target=publish, args=(f"s{index}",)) for index in range(8)]
    for thread in threads:
        thread.start()
    arrivals: list[Arrival] = []
    boundaries = []
    while any(thread.is_alive() for thread in threads):
        until = time.time_ns()
        arrivals += intake.drain(until)
        boundaries.append((len(arrivals), until))
    arrivals += intake.drain(time.time_ns())
    for thread in threads:
        thread.join()

    times = [arrival.received for arrival in arrivals]
    assert len(times) == 16_000
    assert all(first <= second for first, second in itertools.pairwise(times))
    for count, until in boundaries:
        assert all(received > until for received in times[count : count + 1])  # and the samples after it
        assert count == 0 or all(received > times[count - 1] for received in times[count : count + 1])
    for index in range(8):  # the order of each publisher is kept
        own = [arrival.key for arrival in arrivals if arrival.stream == f"s{index}"]
        assert own == [f"k/{number}" for number in range(2_000)]


def test_receive_times_stay_monotonic_when_the_clock_steps_back() -> None:
    clock = Clock(100)
    intake = Intake(clock)
    put = intake.putter("s")
    for now in (100, 100, 40, 101, 500):
        clock.now = now
        put([("k", b"")])
    assert [arrival.received for arrival in intake.drain(0)] == [100, 100, 100, 101, 500]


def test_a_message_after_a_drain_is_later_than_its_tick() -> None:
    intake = Intake(Clock(100))
    put = intake.putter("s")
    assert intake.drain(1_000) == []
    put([("k", b"")])
    assert [arrival.received for arrival in intake.drain(1_000)] == [1_001]
    assert intake.last == 1_001


def test_a_full_queue_drops_and_counts_new_messages() -> None:
    intake = Intake(Clock(0), maximum_bytes=2 * SAMPLE_OVERHEAD)
    put = intake.putter("s")
    for key in "abcd":
        put([(key, b"")])
    assert intake.dropped == 2
    assert [arrival.key for arrival in intake.drain(0)] == ["a", "b"]
    put([("e", b"")])
    assert [arrival.key for arrival in intake.drain(0)] == ["e"]
    assert intake.dropped == 2


def test_the_queued_bytes_are_bounded_over_all_streams() -> None:
    intake = Intake(Clock(0), maximum_bytes=10 + 2 * SAMPLE_OVERHEAD)
    first, second = intake.putter("s"), intake.putter("t")
    first([("a", b"12345")])
    second([("b", b"67890")])
    first([("c", b"")])
    assert intake.dropped == 1
    assert [arrival.key for arrival in intake.drain(0)] == ["a", "b"]
    first([("d", b"1")])
    assert intake.dropped == 1


def test_after_a_step_back_of_the_clock_time_continues_from_there() -> None:
    clock = Clock(1_000)
    intake = Intake(clock)
    put = intake.putter("s")
    put([("a", b"")])
    clock.now = 200
    assert [arrival.received for arrival in intake.drain(0)] == [1_000]
    intake.step_back(200)
    put([("b", b"")])
    assert [arrival.received for arrival in intake.drain(0)] == [201]


def test_each_drain_returns_later_times_than_the_one_before() -> None:
    clock = Clock(100)
    intake = Intake(clock)
    put = intake.putter("s")
    put([("a", b""), ("b", b"")])
    assert [arrival.received for arrival in intake.drain(50)] == [100, 100]
    put([("c", b""), ("d", b"")])
    assert [arrival.received for arrival in intake.drain(50)] == [101, 101]


def test_each_message_has_its_own_enqueue_time() -> None:
    ticks = itertools.count(100)
    intake = Intake(lambda: next(ticks))
    intake.putter("s")([("a", b""), ("b", b""), ("c", b"")])
    assert [(each.key, each.received) for each in intake.drain(0)] == [("a", 100), ("b", 101), ("c", 102)]


def test_all_samples_of_a_message_share_its_time() -> None:
    ticks = itertools.count(100)
    intake = Intake(lambda: next(ticks), maximum_bytes=4 * SAMPLE_OVERHEAD)
    put = intake.putter("s", "t")
    put([("a", b""), ("b", b"")])
    put([("c", b"")])
    assert [(each.received, each.stream, each.key) for each in intake.drain(0)] == [
        (100, "s", "a"),
        (100, "t", "a"),
        (101, "s", "b"),
        (101, "t", "b"),
    ]
    assert intake.dropped == 2  # client c's samples


def test_a_lossless_put_waits_for_room_up_to_a_timeout() -> None:
    intake = Intake(Clock(1), maximum_bytes=SAMPLE_OVERHEAD)
    put = intake.blocking_putter("tokens", timeout=0.02)
    put([("k", b"first")])
    put([("k", b"given up")])
    assert intake.dropped == 1
    patient = intake.blocking_putter("tokens", timeout=PATIENCE)
    waiting = threading.Thread(target=patient, args=([("k", b"second")],))
    waiting.start()
    assert [arrival.payload for arrival in intake.drain(2)] == [b"first"]
    waiting.join(PATIENCE)
    assert [arrival.payload for arrival in intake.drain(3)] == [b"second"]
