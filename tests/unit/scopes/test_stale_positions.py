"""Road users that leave the view: their last positions expire soon, and uses of older ones are reported."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from itertools import combinations
from math import dist
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from detector.commands.cli import main
from detector.engine.samples.sample import Arrival
from detector.findings.losses import Losses
from detector.replay.replaying import ReplayResult, replay_arrivals
from tests.driving import Drive, a_detector, a_rule, a_stream, arrival, at

EDGE = 60.0
"""Metres from the middle of the crossing: what is further out is not in the picture."""

PERIOD = 0.1

NEAR_MISS: dict[str, Any] = {
    "scope": {"pairs": {"position": {"stream": "track", "x": "msg.x", "y": "msg.y"}, "within": 50}},
    "signals": [{"name": name, "stream": "track", "value": f"msg.{name}"} for name in ("vx", "vy")],
    "evaluation": {"every": "100ms"},
    "when": "timeToCollision(b.position.x - a.position.x, b.position.y - a.position.y, b.vx - a.vx, b.vy - a.vy, 2)"
    " < 1.5",
}


CLOSING: dict[str, Any] = {
    "scope": NEAR_MISS["scope"],
    "evaluation": NEAR_MISS["evaluation"],
    "when": "timeToCollision(distance, closingSpeed) < 1.5",
}


class User(NamedTuple):
    """A road user that crosses straight: in the middle of the lane at `start` (s), at a speed (m/s)."""

    name: str
    start: float
    lane: tuple[float, float, float, float]
    """A place, and the direction."""
    speed: float

    def sample(self, time: float) -> dict[str, float] | None:
        """The observed sample; None outside of the view."""
        x, y, dx, dy = self.lane
        way = (time - self.start) * self.speed
        here = {"x": x + dx * way, "y": y + dy * way, "vx": dx * self.speed, "vy": dy * self.speed}
        return here if max(abs(here["x"]), abs(here["y"])) <= EDGE else None


LANES = [(0.0, -2.0, 1.0, 0.0), (0.0, 2.0, -1.0, 0.0), (2.0, 0.0, 0.0, 1.0), (-2.0, 0.0, 0.0, -1.0)]


def traffic(seed: int, seconds: float = 50.0) -> list[User]:
    """Vehicles one behind the other in four lanes, at distances that drivers keep; those who cross may come close."""
    picked = random.Random(seed)
    users = []
    for lane in LANES:
        speed, time = picked.uniform(7, 14), picked.uniform(0, 5)
        while time < seconds:
            users.append(User(f"user-{len(users):03}", time, lane, speed))
            time += picked.uniform(1.5, 6)
    return users


def seconds_apart(one: dict[str, float], other: dict[str, float]) -> float:
    """The time until two discs touch whose centres are then 2 m apart; infinite where they never do."""
    x, y, vx, vy = (other[name] - one[name] for name in ("x", "y", "vx", "vy"))
    square, half, rest = vx * vx + vy * vy, x * vx + y * vy, x * x + y * y - 4
    if rest <= 0:
        return 0.0
    root = half * half - square * rest
    return (-half - root**0.5) / square if root >= 0 > half else float("inf")


def near_misses(users: list[User], seconds: float) -> set[str]:
    """The pairs that come close, by their true ways, while both are in the picture."""
    found = set()
    for number in range(round(seconds / PERIOD)):
        seen = [(user.name, sample) for user in users if (sample := user.sample(number * PERIOD)) is not None]
        for index, (name, sample) in enumerate(seen):
            for other, its in seen[index + 1 :]:
                if seconds_apart(sample, its) < 1.5 and dist((sample["x"], sample["y"]), (its["x"], its["y"])) <= 50:
                    found.add(f"{name}+{other}")
    return found


def closing_in(users: list[User], seconds: float) -> set[str]:
    """The pairs that would meet soon at the rate of the last second, by their true ways, while both are in the picture.

    Somebody is in the picture without a break, so who is there now and was a second ago was there in between.
    """
    found = set()
    ticks = [
        {user.name: (here["x"], here["y"]) for user in users if (here := user.sample(number * PERIOD)) is not None}
        for number in range(round(seconds / PERIOD))
    ]
    for before, now in zip(ticks, ticks[10:], strict=False):
        for one, other in combinations(sorted(before.keys() & now.keys()), 2):
            gap, wider = dist(now[one], now[other]), dist(before[one], before[other])
            if gap <= 50 and gap < 1.5 * (wider - gap):
                found.add(f"{one}+{other}")
    return found


def recorded(users: list[User], seconds: float) -> Iterator[Arrival]:
    for number in range(round(seconds / PERIOD)):
        for user in users:
            if (sample := user.sample(number * PERIOD)) is not None:
                yield arrival(number * PERIOD, user.name, sample, "track")


def replayed(users: list[User], rule: dict[str, Any], **stream: Any) -> ReplayResult:
    detector = a_detector(a_stream("track", **stream))
    return replay_arrivals([[*recorded(users, 60)]], detector, [a_rule("near-miss", **rule)])


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("rule", "true_pairs"), [(NEAR_MISS, near_misses), (CLOSING, closing_in)])
def test_a_pairs_rule_finds_no_ghosts_of_road_users_that_left(
    rule: dict[str, Any], true_pairs: Callable[[list[User], float], set[str]], seed: int
) -> None:
    """With the README's kind of Detector: a stream with no settings about age."""
    users = traffic(seed)
    started = {event.episode.subject for event in replayed(users, rule).events if event.started}
    expected = true_pairs(users, 60)
    assert expected
    assert started == expected


def places(client: str, *samples: tuple[float, float]) -> list[Arrival]:
    """Where a client is, as times and metres."""
    return [arrival(time, client, {"x": x, "y": 0}, "pose") for time, x in samples]


def near(**position: Any) -> Any:
    place = {"stream": "pose", "x": "msg.x", "y": "msg.y", **position}
    return a_rule(
        "near",
        scope={"pairs": {"position": place, "within": 100}},
        when="distance < 10",
        evaluation={"every": "100ms"},
        unknownTimeout="1m",
    )


@pytest.mark.parametrize(
    ("position", "stream", "last"),
    [
        ({}, {}, 1.0),  # the default
        ({"maxAge": "500ms"}, {}, 0.5),
        ({"maxAge": "4s"}, {}, 4.0),
        ({"maxAge": "4s"}, {"staleAfter": "2s"}, 2.0),
        ({}, {"staleAfter": "500ms"}, 0.5),
        ({}, {"staleAfter": "20s"}, 1.0),
        ({}, {"staleAfter": "Never"}, None),  # the last sample stays valid: it has no maximum age
        ({"maxAge": "2s"}, {"staleAfter": "Never"}, 2.0),
    ],
)
def test_a_position_older_than_max_age_is_unknown(
    position: dict[str, Any], stream: dict[str, Any], last: float | None
) -> None:
    """One client speaks once and stays silent; the other reaches it when the position is `last` seconds old."""
    for after, known in ((last, True), ((last or 0) + 0.1, False)) if last is not None else ((9.0, True),):
        drive = Drive(a_detector(a_stream("pose", **stream)), near(**position))
        arrivals = [*places("b", (1.0, 50)), *places("a", (1.0, 0), (0.95 + (after or 0), 50))]
        reported = drive.take(*sorted(arrivals), until=1 + (after or 0))
        assert bool(reported) is known, (after, reported)


def test_by_default_a_signal_is_unknown_after_five_seconds_or_when_its_client_is_lost() -> None:
    speed = {"name": "v", "stream": "speed", "value": "msg.v"}
    for timeout, last in (("30s", 5), ("2s", 2)):
        rule = a_rule("r", scope={"fleet": {"members": "v > 1"}}, signals=[speed], when="size(members) == 0")
        drive = Drive(a_detector(a_stream("speed"), clientTimeout=timeout), rule)
        reported = drive.take(arrival(0.001, "car", {"v": 3}), arrival(1, "car", {"v": 3}), until=20)
        assert reported == [f"r ~fleet started {2 + last}"]


def left_behind(tmp_path: Path, stay: float, **stream: Any) -> list[str]:
    """Files with a Detector and a rule over speeds, and a recording of clients that come, and leave after `stay` s."""
    rule = a_rule("fast", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10")
    lines = [
        {"t": at(start + number / 10), "key": f"vehicles/car{start}/speed", "value": {"v": 3}}
        for start in range(0, 40, 2)
        for number in range(round(stay * 10))
    ]
    (tmp_path / "detector.yaml").write_text(json.dumps(a_detector(a_stream("speed", **stream)).to_json()))
    (tmp_path / "rules.yaml").write_text(json.dumps(rule.to_json()))
    (tmp_path / "drive.jsonl").write_text("".join(json.dumps(line) + "\n" for line in sorted(lines, key=_time)))
    return [str(tmp_path / name) for name in ("detector.yaml", "rules.yaml", "drive.jsonl", "out")]


def _time(line: dict[str, Any]) -> int:
    return int(line["t"])


def ran(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["detector", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    return int(left.value.code or 0)


def test_check_and_replay_warn_of_old_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    detector, rules, drive, out = left_behind(tmp_path, stay=5.0, staleAfter="20s")
    warning = "warning: EventRule fast used old samples of stream speed: they arrive every 0.1 s, but "
    remedy = "lower streams[speed].staleAfter\n"
    for arguments, code in (
        (["replay", drive, "--detector", detector, "--rules", rules, "--output", out], 0),
        (["check", detector, rules, "--recording", drive], 0),
        (["check", "--strict", detector, rules, "--recording", drive], 1),
    ):
        assert ran(monkeypatch, *arguments) == code
        logged = capsys.readouterr().err
        assert warning in logged
        assert remedy in logged.replace(" [old-samples]", "")
    left_behind(tmp_path, stay=5.0, staleAfter="300ms")
    assert ran(monkeypatch, "check", "--strict", detector, rules, "--recording", drive) == 0
    assert "warning" not in capsys.readouterr().err


def test_a_stream_that_goes_stale_between_its_samples_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    detector, rules, drive, _ = left_behind(tmp_path, stay=5.0)
    lines = [{"t": at(8.0 * n), "key": "vehicles/car/speed", "value": {"v": 3}} for n in range(10)]
    Path(drive).write_text("".join(json.dumps(line) + "\n" for line in lines))
    ran(monkeypatch, "check", detector, rules, "--recording", drive)
    logged = "samples of stream speed arrive every 8 s and go stale after 5 s, so EventRule fast has unknown values"
    warned = capsys.readouterr().err
    assert logged in warned
    assert " [stale-between-samples]" in warned


def test_a_rule_about_pairs_is_warned_of_the_maximum_age_as_well(caplog: pytest.LogCaptureFixture) -> None:
    position = {"stream": "speed", "x": "msg.v", "y": "0.0"}
    rule = a_rule("near", scope={"pairs": {"position": position, "within": 10}}, when="distance < 1")
    drive = Drive(a_detector(a_stream("speed")), rule)
    drive.take(arrival(0.5, "a", {"v": 3}), arrival(0.5, "b", {"v": 3}), until=4)
    Losses(drive.engine).sum_up()
    (reported,) = [each for each in caplog.messages if "unknown values" in each]
    assert "no sample or an old one (a position is old after its maxAge)" in reported
