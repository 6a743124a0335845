"""Scopes: pairs with roles, closing speed, positions on the Earth, the fleet, and the elements of `each`."""

from __future__ import annotations

from typing import Any

import pytest

from detector.engine.episodes.demands import from_task, to_task
from tests.driving import POSITION, SPEED, Drive, a_deploy, a_detector, a_rule, a_stream, arrival, at, place, speed

ROLES = [{"name": name, "labels": {"role": name[:-1]}} for name in ("bus1", "bus2", "car1", "car2")]
EARTH = {"stream": "pose", "latitude": "msg.lat", "longitude": "msg.lon"}


def pairs(name: str = "p", *, scope: dict[str, Any] | None = None, **spec: Any) -> Any:
    of_pairs = {"position": POSITION, "within": 250, **(scope or {})}
    return a_rule(name, **{"scope": {"pairs": of_pairs}, "when": "distance < 150", **spec})


def role(name: str) -> dict[str, str]:
    return {"where": f"labels.role == '{name}'"}


# Roles


def test_with_roles_each_matching_ordered_pair_is_a_subject() -> None:
    rule = pairs(scope={"a": role("car"), "b": role("bus")})
    drive = Drive(a_detector(clients=ROLES), rule)
    here = [place(0.5, name, n) for n, name in enumerate(("bus1", "bus2", "car1", "car2", "unlabelled"))]
    assert drive.take(*here, until=1) == [
        "p car1+bus1 started 1",
        "p car1+bus2 started 1",
        "p car2+bus1 started 1",
        "p car2+bus2 started 1",
    ]
    assert drive.events[0].episode.clients == ("car1", "bus1")
    assert drive.events[0].values["a"]["client"] == "car1"


def test_two_clients_that_match_both_roles_are_two_subjects() -> None:
    rule = pairs(scope={"a": {"where": "true"}}, when="a.position.x < b.position.x || distance < 5")
    drive = Drive(a_detector(), rule)
    assert drive.take(place(0.5, "x", 10), place(0.5, "y", 0), until=1) == ["p y+x started 1"]
    assert drive.take(place(1.5, "y", 9), until=2) == ["p x+y started 2"]


def test_a_lost_role_ends_the_episode_and_an_unknown_one_starts_none() -> None:
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="2s"), clients=ROLES)
    rule = pairs(scope={"a": {"where": "'speed' in streams"}, "b": {"where": "labels.role == 'bus'"}})
    drive = Drive(detector, rule)
    reported = drive.take(
        *sorted([speed(0.5, 1, "car1"), *(place(n + 0.5, c, 0) for n in range(5) for c in ("car1", "bus1", "new"))]),
        until=5,
    )
    assert reported == ["p car1+bus1 started 1", "p car1+bus1 OutOfScope 3"]
    assert any("role" in message for message in drive.engine.counters.rules["p"].absences)


def test_a_restored_pair_with_roles_needs_no_order_of_names() -> None:
    rule = pairs(scope={"a": role("car"), "b": role("bus")}, actions=[a_deploy("x")])
    drive = Drive(a_detector(clients=ROLES), rule)
    drive.take(place(0.5, "car1", 0), place(0.5, "bus1", 0), until=1)
    demands = list(drive.engine.demands().values())
    again = Drive(a_detector(clients=ROLES), rule)
    assert again.note(again.engine.restore(demands, at(0))) == []
    assert list(again.engine.demands().values()) == demands


# Closing speed


def test_the_closing_speed_is_the_decrease_of_the_distance_over_the_last_second() -> None:
    rule = pairs(when="closingSpeed >= 10.0", until="closingSpeed < 0.0", evaluation={"every": "500ms"})
    drive = Drive(a_detector(), rule)
    moving = [place(n / 10, "a", 100 - n * 1.5 if n <= 30 else 55 + n) for n in range(1, 60)]
    still = [place(n / 10, "b", 0) for n in range(1, 60)]
    assert drive.take(*sorted(moving + still), until=5) == ["p a+b started 1.5", "p a+b Until 3.5"]
    assert drive.events[0].values["closingSpeed"] == pytest.approx(15)


def test_the_closing_speed_at_constant_distance_is_an_unsigned_zero() -> None:
    drive = Drive(a_detector(), pairs(when="closingSpeed == 0.0", evaluation={"every": "500ms"}))
    drive.take(*(place(t, c, 0) for t in (0.5, 1, 1.5) for c in "ab"), until=1.5)
    assert str(drive.events[0].values["closingSpeed"]) == "0.0"


def test_the_closing_speed_is_unknown_without_a_position_a_second_ago() -> None:
    detector = a_detector(a_stream("pose", staleAfter="500ms"))
    rule = pairs(when="closingSpeed > -1000.0", until="false", evaluation={"every": "500ms"})
    drive = Drive(detector, rule)
    both = [place(t, c, 0) for t in (0.1, 0.9, 1.4) for c in "ab"]
    assert drive.take(*both, until=1) == []  # the sample that was the newest at 0 is none
    assert drive.take(place(1.45, "a", 0), until=1.5) == [
        "p a+b started 1.5"
    ]  # at 0.4, a second before the newest of b, there was one of 0.1
    drive = Drive(detector, rule)
    drive.take(*both, until=1)
    drive.engine.gap(at(1.2))
    assert drive.take(place(1.45, "a", 0), until=1.5) == []


def test_the_closing_speed_ends_with_the_last_position_of_a_silent_client() -> None:
    """Two drive one behind the other at 10 m/s, and the one in front leaves."""
    behind = [place(n / 10, "a", n) for n in range(1, 60)]
    ahead = [place(n / 10, "b", 9 + n) for n in range(1, 31)]
    conditions = {"met": "distance < 1.0 && closingSpeed == 0.0", "closed": "closingSpeed > 0.0"}
    rules = [pairs(name, when=when, evaluation={"every": "100ms"}) for name, when in conditions.items()]
    drive = Drive(a_detector(), *rules)
    assert drive.take(*sorted(behind + ahead), until=4) == ["met a+b started 3.9", "met a+b Until 4"]


def test_the_closing_speed_to_a_position_that_never_goes_stale_is_current() -> None:
    """A station sends its position once."""
    rule = pairs(scope={"position": EARTH}, when="closingSpeed > 10.0", evaluation={"every": "500ms"})
    drive = Drive(a_detector(a_stream("pose", staleAfter="Never")), rule)
    car = [north(20 + n / 2, "car", 0.001 - 0.0001 * n, 0) for n in range(8)]
    assert drive.take(north(0.5, "station", 0, 0), *car, until=23) == ["p car+station started 21"]
    assert drive.events[0].values["closingSpeed"] == pytest.approx(22.11, abs=0.01)


# On the Earth


def north(seconds: float, client: str, latitude: Any, longitude: Any) -> Any:
    return arrival(seconds, client, {"lat": latitude, "lon": longitude}, "pose")


def test_positions_on_the_earth_work_across_the_antimeridian_and_over_the_pole() -> None:
    rule = pairs(scope={"position": EARTH, "within": 30}, when="distance < 25.0")
    drive = Drive(a_detector(), rule)
    reported = drive.take(
        north(0.1, "a", 0, 179.9999),
        north(0.2, "b", 0, -179.9999),
        north(0.3, "c", 89.9999, 0),
        north(0.4, "d", 89.9999, 180),
        north(0.5, "e", 0, 179.9990),
        until=1,
    )
    assert reported == ["p a+b started 1", "p c+d started 1"]
    assert drive.events[0].values["distance"] == pytest.approx(22.264, abs=1e-3)
    assert drive.events[0].values["a"]["position"] == {"latitude": 0, "longitude": 179.9999}


def test_an_invalid_latitude_is_not_a_position() -> None:
    drive = Drive(a_detector(), pairs(scope={"position": EARTH, "within": 30}))
    assert drive.take(north(0.1, "a", 91, 0), north(0.2, "b", None, 0), north(0.3, "c", 0, 0), until=1) == []
    assert drive.engine.counters.rules["p"].misplaced == 2


# Too many pairs


def test_pairs_beyond_the_maximum_are_skipped_and_counted_but_never_open_ones() -> None:
    drive = Drive(a_detector(), pairs(scope={"maxPairs": 2}))
    assert drive.take(*(place(0.5, c, n * n) for n, c in enumerate("abcd")), until=1) == [
        "p a+b started 1",
        "p b+c started 1",
    ]
    assert drive.engine.counters.rules["p"].crowded_pairs == 4
    assert drive.take(place(1.5, "a", 2), place(1.6, "d", 3), until=2) == ["p a+d started 2"]
    reported = drive.take(place(2.5, "b", 900), until=3)
    assert reported == ["p a+b Until 3", "p b+c Until 3", "p c+d started 3"]


# The fleet


def fleet(members: str = "true", **spec: Any) -> Any:
    return a_rule("f", **{"scope": {"fleet": {"members": members}}, "signals": [SPEED], **spec})


def test_the_fleet_is_one_subject_with_all_certain_members() -> None:
    drive = Drive(a_detector(), fleet("speed > 0.0", when="size(members) >= 2", until="size(members) < 1"))
    assert drive.take(speed(0.5, 1, "a"), speed(0.5, None, "b"), place(0.5, "c", 0), until=1) == []
    assert drive.take(speed(1.5, 3, "b"), until=2) == ["f ~fleet started 2"]
    (event,) = drive.events
    assert event.episode.clients == ()
    assert event.values == {"count": 2, "members": [{"client": "a", "speed": 1}, {"client": "b", "speed": 3}]}
    assert event.key == "wayside/events/h/f/~fleet"
    assert drive.take(speed(2.5, 0, "a"), until=3) == []
    assert drive.take(speed(3.5, -1, "b"), until=4) == ["f ~fleet Until 4"]


def test_a_fleet_rule_is_evaluated_without_clients_and_survives_lost_ones() -> None:
    drive = Drive(a_detector(clientTimeout="3s"), fleet(when="size(members) == 0", until="size(members) > 1"))
    assert drive.take(until=1) == ["f ~fleet started 1"]
    assert drive.take(speed(1.5, 1), until=6) == []
    assert drive.take(speed(6.5, 1, "a"), speed(6.5, 1, "b"), until=7) == ["f ~fleet Until 7"]


def test_expressions_over_members_follow_kleene() -> None:
    drive = Drive(a_detector(), fleet(when="members.exists(m, m.speed > 10)", until="members.all(m, m.speed < 5)"))
    assert drive.take(place(0.5, "a", 0), speed(0.5, 5, "b"), until=1) == []  # a's speed is unknown
    assert drive.take(speed(1.5, 11, "b"), until=2) == ["f ~fleet started 2"]
    assert drive.take(speed(2.5, 1, "b"), until=3) == []
    assert drive.take(speed(3.5, 1, "a"), until=4) == ["f ~fleet Until 4"]


def test_an_episode_of_the_fleet_is_restored_from_its_task() -> None:
    rule = fleet(when="size(members) > 0", until="false", actions=[a_deploy("x", parameters={"n": "${size(members)}"})])
    drive = Drive(a_detector(), rule)
    drive.take(speed(0.5, 1), until=1)
    (demand,) = drive.engine.demands().values()
    assert demand.parameters == {"n": 1}
    again = Drive(a_detector(), rule)
    restored = from_task(to_task(demand))
    assert restored is not None
    assert again.note(again.engine.restore([restored], at(0))) == []
    assert again.take(speed(1.5, 1), until=3) == []


# Each

SITES = {
    "as": "site",
    "of": [{"name": "south", "x": 500, "node": "rsu-2"}, {"name": "north", "x": 120, "node": "rsu-1"}],
}


def test_a_rule_with_elements_is_evaluated_once_for_each() -> None:
    rule = a_rule(
        each=SITES,
        signals=[{"name": "x", "stream": "pose", "value": "msg.x"}],
        when="x > site.x",
        actions=[a_deploy("d", parameters={"node": "${site.node}", "at": "${x - site.x}"})],
    )
    drive = Drive(a_detector(), rule)
    assert drive.take(place(0.5, "car", 130), until=1) == ["r car~north started 1"]
    assert drive.take(place(1.5, "car", 510), until=2) == ["r car~south started 2"]
    assert {demand.episode.subject: demand.parameters for demand in drive.engine.demands().values()} == {
        "car~north": {"node": "rsu-1", "at": 10},
        "car~south": {"node": "rsu-2", "at": 10},
    }
    assert drive.take(place(2.5, "car", 0), until=3) == ["r car~north Until 3", "r car~south Until 3"]
    first = drive.events[0].cloud_event()
    assert first["subject"] == "car~north"
    assert first["data"]["element"] == "north"
    assert first["data"]["subjects"] == ["car"]


def test_signals_may_read_the_element_and_are_then_computed_for_each() -> None:
    beyond = {"name": "beyond", "stream": "pose", "value": "msg.x - site.x", "over": "3s", "aggregate": "Max"}
    there = {"name": "there", "stream": "pose", "where": "msg.x > site.x", "over": "9s", "aggregate": "Count"}
    since = {"name": "since", "stream": "pose", "where": "msg.x > site.x", "aggregate": "Age"}
    rule = a_rule(each=SITES, signals=[beyond, there, since, SPEED], when="beyond > 0.0", until="since > 2.0")
    drive = Drive(a_detector(), rule)
    places = (0, 130, 140, 600, 0, 0, 0)
    reported = drive.take(*sorted([*(place(n + 0.5, "car", x) for n, x in enumerate(places)), speed(0.6, 5)]), until=7)
    assert reported == ["r car~north started 2", "r car~south started 4", "r car~north Until 6", "r car~south Until 6"]
    north, south = (event.values for event in drive.events[:2])
    assert north == {"beyond": 10, "there": 1, "since": 0.5, "speed": 5}
    assert south == {"beyond": 100, "there": 1, "since": 0.5, "speed": 5}


def test_signals_that_read_the_element_in_pairs_and_in_the_fleet() -> None:
    signals = [{"name": "beyond", "stream": "pose", "value": "msg.x - site.x"}, SPEED]
    here = [place(0.5, "a", 130), place(0.5, "b", 140), place(0.5, "c", 510), speed(0.6, 7, "a")]
    scope = {"position": POSITION, "within": 50}
    rule = pairs(scope=scope, each=SITES, signals=signals, when="a.beyond > 0.0 && b.beyond > 0.0")
    drive = Drive(a_detector(), rule)
    assert drive.take(*sorted(here), until=1) == ["p a+b~north started 1"]
    a = drive.events[0].values["a"]
    assert a == {"client": "a", "beyond": 10, "speed": 7, "position": {"x": 130, "y": 0, "z": 0}}
    rule = a_rule(
        scope={"fleet": {"members": "beyond > 0.0"}},
        each=SITES,
        signals=signals,
        when="members.all(m, m.beyond < 400.0)",
    )
    drive = Drive(a_detector(), rule)
    assert drive.take(*sorted(here), until=1) == ["r ~fleet~north started 1", "r ~fleet~south started 1"]
    assert [event.values["count"] for event in drive.events] == [3, 1]


def test_elements_in_every_scope_and_its_conditions() -> None:
    clients = [{"name": name, "labels": {"site": name[0]}} for name in ("n1", "n2", "s1")]
    each = {"as": "site", "of": [{"name": "n"}, {"name": "s"}]}
    here = [place(0.5, name["name"], 0) for name in clients]
    reported = {}
    for scope in (
        {"client": {"where": "labels.site == site.name"}},
        {"pairs": {"position": POSITION, "within": 9, "where": "a.labels.site == site.name"}},
        {"pairs": {"position": POSITION, "within": 9, "a": {"where": "labels.site == site.name"}}},
        {"fleet": {"members": "labels.site == site.name"}},
    ):
        when = "size(members) == 1" if "fleet" in scope else "true"
        drive = Drive(a_detector(clients=clients), a_rule(scope=scope, each=each, when=when))
        drive.take(*here, until=1)
        reported[str(scope)] = [event.episode.subject for event in drive.events]
    assert list(reported.values()) == [
        ["n1~n", "n2~n", "s1~s"],
        ["n1+n2~n", "n1+s1~n", "n2+s1~n"],
        ["n1+n2~n", "n1+s1~n", "n2+n1~n", "n2+s1~n", "s1+n1~s", "s1+n2~s"],
        ["~fleet~s"],
    ]


def test_an_episode_of_an_element_is_restored_and_ends_with_a_removed_element() -> None:
    rule = a_rule(each=SITES, when="'pose' in streams", actions=[a_deploy("x")])
    drive = Drive(a_detector(), rule)
    drive.take(place(0.5, "car", 0), until=1)
    held = drive.engine.demands()
    assert sorted(demand.episode.subject for demand in held.values()) == ["car~north", "car~south"]
    again = Drive(a_detector(), rule)
    assert again.note(again.engine.restore(list(held.values()), at(0))) == []
    assert again.engine.demands() == held
    fewer = a_rule(each={"as": "site", "of": SITES["of"][:1]}, when="'pose' in streams", actions=[a_deploy("x")])
    less = Drive(a_detector(), fewer)
    assert less.note(less.engine.restore(list(held.values()), at(0))) == [
        "r car~north RuleChanged 0",
        "r car~south RuleChanged 0",
    ]


def test_a_signal_over_another_rule_may_pick_the_episodes_of_its_own_element() -> None:
    passed = a_rule(
        "passed", each=SITES, signals=[{"name": "x", "stream": "pose", "value": "msg.x"}], when="x > site.x"
    )
    starts = {
        "name": "starts",
        "ruleName": "passed",
        "where": "msg.element == site.name",
        "over": "9s",
        "aggregate": "Count",
    }
    again = a_rule("again", each=SITES, signals=[starts], when="starts >= 2.0")
    drive = Drive(a_detector(), passed, again)
    reported = drive.take(*(place(n + 0.5, "car", x) for n, x in enumerate((130, 0, 130, 600))), until=4)
    assert [each for each in reported if each.startswith("again")] == ["again car~north started 3"]
