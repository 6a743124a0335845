"""Open episodes are kept in the state volume: they survive a kill, and a broken file causes no failure."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from detector.actions.deploy.file_store import FileTaskStore
from detector.engine.episodes.demands import to_task
from detector.engine.episodes.record import EpisodeRecord, OpenEpisode, from_document
from detector.engine.episodes.subjects import Subject
from detector.live.state import StateFile, state_file, what_was_open
from detector.streams.zenoh import open_session
from tests import programs
from tests.driving import Drive, a_deploy, a_detector, a_rule, arrival, at
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from wayside.api.zenoh import Zenoh, ZenohMode

SPEED = {"name": "speed", "stream": "speed", "value": "msg.v"}


def speeding(**spec: Any) -> Any:
    return a_rule(signals=[SPEED], **{"when": "speed > 10", "until": "speed < 5", **spec})


def speed(seconds: float, value: Any, client: str = "car") -> Any:
    return arrival(seconds, client, {"v": value})


def open_in(rule: Any) -> list[OpenEpisode]:
    drive = Drive(a_detector(), rule, start=-100)
    drive.take(speed(-99.5, 20), speed(-99.4, 30, "bus"), until=-99)
    return drive.engine.open_episodes()


def by_subject(episodes: list[OpenEpisode]) -> list[OpenEpisode]:
    return sorted(episodes, key=lambda each: each.record.subject)


def saved(folder: Path, episodes: list[OpenEpisode]) -> StateFile:
    state = StateFile(folder, "default", "h")
    state.save(episodes)
    state.close()
    return state


# The engine


def test_an_episode_without_a_task_continues_after_a_restart() -> None:
    episodes = open_in(speeding())
    drive = Drive(a_detector(), speeding())
    assert drive.note(drive.engine.restore([], at(0), episodes)) == []
    assert by_subject(drive.engine.open_episodes()) == by_subject(episodes)
    assert drive.take(speed(0.5, 7), speed(0.6, 3, "bus"), until=1) == ["r bus Until 1"]
    assert drive.events[0].episode.id == next(each.record.id for each in episodes if each.record.subject == "bus")
    assert drive.events[0].episode.start_time == at(-99)


def test_a_restored_episode_ends_if_its_rule_changed_meanwhile() -> None:
    drive = Drive(a_detector(), speeding(when="speed > 11"))
    assert drive.note(drive.engine.restore([], at(0), open_in(speeding()))) == [
        "r bus RuleChanged 0",
        "r car RuleChanged 0",
    ]
    assert drive.engine.open_episodes() == []


def test_an_episode_in_a_task_and_in_the_state_is_restored_once_from_the_task() -> None:
    rule = speeding(actions=[a_deploy("x", parameters={"v": "${speed}"})])
    before = Drive(a_detector(), rule, start=-100)
    before.take(speed(-99.5, 20), until=-99)
    demands = list(before.engine.demands().values())
    drive = Drive(a_detector(), rule)
    assert drive.note(drive.engine.restore(demands, at(0), before.engine.open_episodes())) == []
    assert list(drive.engine.demands().values()) == demands


def test_an_episode_whose_task_was_never_made_demands_it_at_the_next_evaluation() -> None:
    rule = speeding(actions=[a_deploy("x", parameters={"v": "${speed}"})])
    drive = Drive(a_detector(), rule)
    drive.engine.restore([], at(0), open_in(rule))
    assert drive.engine.demands() == {}
    drive.take(speed(0.5, 8), until=1)
    assert [(demand.episode.start_time, demand.parameters) for demand in drive.engine.demands().values()] == [
        (at(-99), {"v": 8})
    ]


# The file

names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=9)
values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=5,
)
times = st.integers(0, 4 * 10**18)


def open_episode(subject: Subject, **fields: Any) -> OpenEpisode:
    return OpenEpisode(EpisodeRecord(subject=subject.text, clients=subject.clients, element=subject.element, **fields))


episodes = st.builds(
    open_episode,
    st.builds(Subject, st.lists(names, max_size=2).map(tuple), st.none() | names),
    id=names,
    rule=names,
    onset_time=times,
    start_time=times,
    values=st.dictionaries(names, values.filter(lambda value: value is not None), max_size=3),
    classification=st.none() | st.just({"incidence": ["Rare"]}),
    rule_digest=names,
)


@given(episodes)
def test_a_saved_episode_reads_back_unchanged(episode: OpenEpisode) -> None:
    assert from_document(json.loads(json.dumps(episode.to_document()))) == episode


def test_the_last_saved_state_is_loaded_and_no_temporary_file_remains(tmp_path: Path) -> None:
    before = open_in(speeding())
    folder = tmp_path / "new" / "state"
    state = StateFile(folder, "default", "h")
    assert state.load() == []
    for count in (1, 2, 0, 2):
        state.save(before[:count])
    state.close()
    assert StateFile(folder, "default", "h").load() == before
    assert StateFile(folder, "default", "other").load() == []
    saved(folder, before[:1])
    assert StateFile(folder, "default", "h").load() == before[:1]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[: len(text) // 2],
        lambda text: b"",
        lambda text: b"\xff" + text,
        lambda text: b"[" * 100_000,
        lambda text: b"[]",
        lambda text: text.replace(b'"version":1', b'"version":2'),
        lambda text: text.replace(b'"holder":"h"', b'"holder":"g"'),
        lambda text: text.replace(b'"subject":"car"', b'"subject":"~"'),
        lambda text: text.replace(b'"subject":"car"', b'"subject":3'),
        lambda text: text.replace(b"2025-12-31T", b"2025-13-31T"),
        lambda text: text.replace(b'"episodes":[', b'"episodes":[7,'),
        lambda text: text.replace(b'"values":{', b'"values":null,"v":{'),
    ],
)
def test_a_broken_file_is_reported_and_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[bytes], bytes]
) -> None:
    before = open_in(speeding())
    path = saved(tmp_path, before).path
    whole = path.read_bytes()
    broken = spoil(whole)
    assert broken != whole
    path.write_bytes(broken)
    state = StateFile(tmp_path, "default", "h")
    with caplog.at_level(logging.ERROR):
        assert state.load() == []
    assert "renamed the file to" in caplog.text
    assert state.set_aside == 1
    (aside,) = tmp_path.glob("*.unreadable-*")
    assert aside.read_bytes() == broken
    assert not path.exists()
    state.save(before)
    state.close()
    assert StateFile(tmp_path, "default", "h").load() == before


def test_a_failing_disk_is_reported_once_and_the_newest_state_is_written_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = open_in(speeding())
    state = StateFile(tmp_path, "default", "h")
    draft = tmp_path / "default_h.new"
    draft.unlink()
    draft.mkdir()  # no file can be written in it now
    for _ in range(3):
        failures = state.failures
        state.save(before[:1])
        wait_for(lambda failures=failures: state.failures > failures, "a write fails")
    assert caplog.text.count("cannot write the state") == 1
    draft.rmdir()
    state.save(before)
    state.close()
    assert StateFile(tmp_path, "default", "h").load() == before


def test_an_episode_whose_task_has_ended_is_not_restored(tmp_path: Path) -> None:
    rule = speeding(actions=[a_deploy("x")])
    drive = Drive(a_detector(), rule, start=-100)
    drive.take(speed(-99.5, 20), speed(-99.4, 30, "bus"), until=-99)
    state = saved(tmp_path / "state", drive.engine.open_episodes())
    store = FileTaskStore(tmp_path / "tasks", "h")

    async def look() -> Any:
        for demand in drive.engine.demands().values():
            await store.create(to_task(demand, at(-50) if demand.episode.subject == "bus" else None))
        return await what_was_open(store, StateFile(tmp_path / "state", "default", "h"))

    restored = asyncio.run(look())
    assert [demand.episode.subject for demand in restored.demands] == ["car"]
    assert [episode.record.subject for episode in restored.episodes] == ["car"]
    assert state.failures == 0


# A real process


class Car:
    """Publishes one value on Zenoh until it is changed."""

    def __init__(self, endpoint: str) -> None:
        self._session = open_session(Zenoh(mode=ZenohMode.PEER, connect=[endpoint]))
        self.value = 20.0

    def wait_for(self, reached: Callable[[], bool], what: str) -> None:
        """Keep publishing until `reached` returns true."""

        def look() -> bool:
            self._session.put("vehicles/car/speed", json.dumps({"v": self.value}).encode())
            return reached()

        wait_for(look, what)

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]


def wait_for(reached: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not reached():
        assert time.monotonic() < deadline, f"not within {PATIENCE:g} s: {what}"
        time.sleep(0.05)


@contextmanager
def running(folder: Path, *options: str) -> Iterator[programs.Program]:
    files = ("--detector", folder / "detector.yaml", "--rules", folder / "rules.yaml", "--output", folder / "out")
    process = programs.Program(["detector", "run", *map(str, files), *options], folder / "log")
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def events_in(file: Path) -> list[str]:
    """The whole lines."""
    return file.read_text().split("\n")[:-1] if file.exists() else []


def test_an_episode_survives_a_kill_and_its_replay_is_byte_identical(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    detector = a_detector(
        zenoh={"mode": "peer", "listen": [endpoint]}, state={"path": str(tmp_path / "state")}
    ).to_json()
    rule = speeding(evaluation={"every": "100ms"}).to_json()
    (tmp_path / "detector.yaml").write_text(yaml.safe_dump(detector))
    (tmp_path / "rules.yaml").write_text(yaml.safe_dump(rule))
    events, state = tmp_path / "out" / "events.jsonl", tmp_path / "state" / "default_d.json"

    def kept() -> list[Any]:
        return json.loads(state.read_text())["episodes"] if state.exists() else []

    with running(tmp_path, "--log-format", "json") as process:
        wait_for(lambda: b"runs with 1 rules" in (tmp_path / "log").read_bytes(), "the detector runs")
        for line in map(json.loads, (tmp_path / "log").read_text().split("\n")[:-1]):
            assert {"time", "level", "logger", "message"} <= line.keys()
        car = Car(endpoint)
        car.wait_for(lambda: len(kept()) == 1 and len(events_in(events)) == 1, "the episode is open and kept")
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    car.close()
    with running(tmp_path, "--record-intake", str(tmp_path / "intake.mcap")) as process:
        wait_for(
            lambda: b"restored 1 open episodes from the state volume" in (tmp_path / "log").read_bytes(), "it is back"
        )
        car = Car(endpoint)
        car.value = 3.0
        car.wait_for(lambda: len(events_in(events)) == 2 and not kept(), "the episode ends")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    car.close()
    started, ended = map(json.loads, events_in(events))
    assert ended["data"]["reason"] == "Until"
    for field in ("episode", "onsetTime", "startTime"):
        assert started["data"][field] == ended["data"][field]
    programs.run("detector", "replay", tmp_path / "intake.mcap", "--output", tmp_path / "again", check=True)
    assert events_in(tmp_path / "again" / "events.jsonl") == events_in(events)[1:]


def test_a_state_folder_that_cannot_be_created_is_reported_by_field(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    detector = a_detector(state={"path": str(tmp_path / "file" / "state")})
    with pytest.raises(OSError, match=r"spec\.state\.path: cannot write .*/file/state \(Not a directory\): give"):
        state_file(detector, "h")
    assert state_file(a_detector(), "h") is None
