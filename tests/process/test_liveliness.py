"""A client is known while its liveliness token exists, live over Zenoh and in a replay."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from detector.actions.deploy.file_store import FileTaskStore
from detector.actions.deploy.reconciler import DemandReconciler
from detector.assembly import DetectorError, stream_readers
from detector.engine.samples import liveliness
from detector.engine.samples.liveliness import LIVELINESS, TokenState
from detector.engine.samples.sample import Arrival
from detector.live.running import Running, RunOptions
from detector.live.state import RestoredState
from detector.replay.intake_file import read_intake
from detector.replay.replaying import replay_intake
from detector.resources.selection import RuleSet
from detector.streams.zenoh import Network
from tests.driving import SECOND, START, Drive, a_detector, a_rule, a_stream, arrival, at, lines
from tests.networks import Arrivals, router, session, stream, wait_for
from wayside.api import Detector
from wayside.api.detector import Clock
from wayside.api.zenoh import Zenoh, ZenohMode

FAST = a_rule("fast", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10", until="v < 5")

HERE = a_rule("here", when="true", until="false")


def alive(seconds: float, client: str, token: TokenState, session: str = "s1") -> Arrival:
    return Arrival(at(seconds), LIVELINESS, f"alive/{client}/{session}", token.value)


def detector(clock: Clock = Clock.WALL) -> Detector:
    return a_detector(
        a_stream("speed", staleAfter="Never", stamp="msg.t" if clock is Clock.DATA else None),
        clientTimeout="3s",
        clock=clock,
        zenoh={"liveliness": "alive/${client:*}/*"},
    )


def test_a_token_alone_makes_a_client_known_and_keeps_it_beyond_the_timeout() -> None:
    drive = Drive(detector(), HERE)
    assert drive.take(alive(0.5, "car1", TokenState.DECLARED), until=1) == ["here car1 started 1"]
    assert drive.take(until=60) == []
    assert drive.take(alive(60.5, "car1", TokenState.DROPPED), until=62) == ["here car1 ClientLost 61"]


def test_a_dropped_token_ends_episodes_at_once_and_the_next_sample_brings_the_client_back() -> None:
    drive = Drive(detector(), FAST)
    drive.take(alive(0.1, "car1", TokenState.DECLARED), arrival(0.2, "car1", {"v": 20}), until=1)
    assert drive.take(arrival(1.1, "car1", {"v": 20}), alive(1.2, "car1", TokenState.DROPPED), until=2) == [
        "fast car1 ClientLost 2"
    ]
    assert drive.take(arrival(2.5, "car1", {"v": 20}), until=3) == ["fast car1 started 3"]
    assert drive.take(until=8) == ["fast car1 ClientLost 6"]


def test_a_client_is_lost_with_its_last_token_only_and_not_if_it_is_declared_again_before_the_tick() -> None:
    drive = Drive(detector(), HERE)
    drive.take(alive(0.1, "car1", TokenState.DECLARED), alive(0.2, "car1", TokenState.DECLARED, "s2"), until=1)
    assert drive.take(alive(1.1, "car1", TokenState.DROPPED), until=10) == []
    again = [alive(10.1, "car1", TokenState.DROPPED, "s2"), alive(10.2, "car1", TokenState.DECLARED)]
    assert drive.take(*again, until=20) == []
    assert drive.take(alive(20.1, "car1", TokenState.DROPPED), until=21) == ["here car1 ClientLost 21"]


def test_after_the_loss_of_our_own_connection_the_client_timeout_decides() -> None:
    drive = Drive(detector(), HERE)
    drive.take(alive(0.1, "car1", TokenState.DECLARED), alive(0.1001, "car2", TokenState.DECLARED), until=10)
    unsure = [alive(10.1, "car1", TokenState.UNSURE), alive(10.1001, "car2", TokenState.UNSURE)]
    assert drive.take(*unsure, alive(12.0, "car2", TokenState.DECLARED), until=20) == ["here car1 ClientLost 14"]


def test_tokens_without_a_client_or_meaning_are_counted() -> None:
    drive = Drive(detector(), HERE)
    wrong = [alive(0.1, "car 1", TokenState.DECLARED), Arrival(at(0.2), LIVELINESS, "alive/car1/s1", b"?")]
    assert drive.take(*wrong, until=1) == []
    assert drive.engine.counters.unnamed[LIVELINESS] == 2
    assert drive.engine.counters.samples[LIVELINESS] == 0


def test_tokens_beyond_the_bound_are_ignored_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(liveliness, "MAXIMUM_TOKENS", 1)
    drive = Drive(detector(), HERE)
    both = [alive(0.1, "car1", TokenState.DECLARED), alive(0.2, "car2", TokenState.DECLARED)]
    assert drive.take(*both, until=1) == ["here car1 started 1"]
    assert drive.engine.counters.crowded[LIVELINESS] == 1


def test_clients_of_a_former_token_pattern_expire_by_timeout() -> None:
    drive = Drive(detector(), HERE)
    drive.take(alive(0.1, "car1", TokenState.DECLARED), until=10)
    changed = a_detector(a_stream("speed"), clientTimeout="3s")
    readers = stream_readers(changed)
    drive.engine.set_detector(changed, readers.decoders, readers.read_key)
    assert drive.take(until=20) == ["here car1 ClientLost 14"]


def test_with_clock_data_a_token_counts_after_the_samples_up_to_the_newest_stamp() -> None:
    drive = Drive(detector(Clock.DATA), FAST)

    def fast(seconds: float, client: str) -> Arrival:
        return arrival(seconds + 100, client, {"v": 20, "t": (START + seconds * SECOND) / 1e9})

    drive.take(alive(100, "car1", TokenState.DECLARED), fast(0.5, "car1"), fast(0.6, "car2"), until=200)
    drive.take(
        fast(1.5, "car2"), fast(2.5, "car1"), alive(102.6, "car1", TokenState.DROPPED), fast(3.5, "car2"), until=200
    )
    assert drive.take(fast(4.5, "car2"), until=200) == []
    assert [line for line in _reported(drive) if "car1" in line] == ["fast car1 started 1", "fast car1 ClientLost 3"]


def _reported(drive: Drive) -> list[str]:
    return Drive.note(drive, []) or [
        f"{e.episode.rule} {e.episode.subject} {e.reason or 'started'} {(e.time - START) / 1e9:g}" for e in drive.events
    ]


def test_an_invalid_token_pattern_is_reported_by_field() -> None:
    with pytest.raises(DetectorError, match=r"spec\.zenoh\.liveliness: key 'a/x\$\{client:\*\}', column 3"):
        stream_readers(a_detector(zenoh={"liveliness": "a/x${client:*}"}))
    with pytest.raises(ValueError, match="liveliness does not capture the client"):
        Zenoh(liveliness="alive/*")


def vehicle(endpoint: str) -> zenoh.Session:
    return session(connect__endpoints=[endpoint])


@pytest.fixture
def watching(endpoint: str, arrivals: Arrivals) -> Iterator[Network]:
    config = Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint], liveliness="alive/${client:*}")
    network = Network(config, [stream()], arrivals.putter)
    network.start()
    yield network
    network.close()


def test_tokens_are_followed_over_the_network(endpoint: str, arrivals: Arrivals, watching: Network) -> None:
    def report(*reported: tuple[str, TokenState]) -> list[tuple[str, str, bytes]]:
        return [(LIVELINESS, f"alive/{client}", token.value) for client, token in reported]

    with router(listen__endpoints=[endpoint]):
        car1, car2 = vehicle(endpoint), vehicle(endpoint)
        kept = car1.liveliness().declare_token("alive/car1")  # Zenoh undeclares a token without references
        token = car2.liveliness().declare_token("alive/car2")
        arrivals.wait_for(
            lambda seen: sorted(seen) == report(("car1", TokenState.DECLARED), ("car2", TokenState.DECLARED))
        )
        arrivals.seen.clear()
        token.undeclare()
        arrivals.wait_for(lambda seen: seen == report(("car2", TokenState.DROPPED)))
    arrivals.wait_for(lambda seen: seen[1:] == report(("car1", TokenState.UNSURE)))
    with router(listen__endpoints=[endpoint]):
        arrivals.wait_for(lambda seen: seen[2:] == report(("car1", TokenState.DECLARED)))
        car1.close()
        arrivals.wait_for(lambda seen: seen[3:] == report(("car1", TokenState.DROPPED)))
        car3 = vehicle(endpoint)
        last = car3.liveliness().declare_token("alive/car3")
        arrivals.wait_for(lambda seen: seen[4:] == report(("car3", TokenState.DECLARED)))
        watching.close()
        arrivals.wait_for(lambda seen: seen[5:] == report(("car3", TokenState.UNSURE)))
        car2.close()
        car3.close()
    del kept, last


def test_a_token_declared_before_the_detector_started_counts(endpoint: str, arrivals: Arrivals) -> None:
    with router(listen__endpoints=[endpoint]), vehicle(endpoint) as car1:
        kept = car1.liveliness().declare_token("alive/car1")
        network = Network(Zenoh(connect=[endpoint], liveliness="alive/${client:*}"), [stream()], arrivals.putter)
        network.start()
        arrivals.wait_for(lambda seen: seen == [(LIVELINESS, "alive/car1", TokenState.DECLARED.value)])
        network.close()
        kept.undeclare()


def test_live_and_replay_agree_on_tokens(endpoint: str, tmp_path: Path) -> None:
    watched = a_detector(zenoh={"connect": [endpoint], "liveliness": "alive/${client:*}"})
    rule = a_rule("here", when="true", until="false", evaluation={"every": "100ms"})
    events = tmp_path / "events.jsonl"

    async def live() -> None:
        reconciler = DemandReconciler(FileTaskStore(tmp_path / "tasks", "h"))
        options = RunOptions(tmp_path, tmp_path / "intake.mcap")
        with Running(RuleSet(watched, (rule,)), "h", reconciler, RestoredState(), options):
            for times, reason in ((1, "ended"), (2, None)):  # the second time, the detector ends first
                car1 = await asyncio.to_thread(vehicle, endpoint)
                token = car1.liveliness().declare_token("alive/car1")
                await asyncio.to_thread(
                    wait_for,
                    lambda times=times: events.exists() and events.read_text().count("event.started") == times,
                )
                if reason is not None:
                    token.undeclare()
                    await asyncio.to_thread(wait_for, lambda: "ClientLost" in events.read_text())
                await asyncio.to_thread(car1.close)

    with router(listen__endpoints=[endpoint]):
        asyncio.run(live())
    outcome = replay_intake(read_intake(tmp_path / "intake.mcap"), None, None)
    assert [line + "\n" for line in lines(outcome.events)] == events.read_text().splitlines(keepends=True)
    assert "ClientLost" in events.read_text()
