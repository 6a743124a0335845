"""Random rules of every scope, for random scenes."""

from __future__ import annotations

from random import Random
from typing import Any

from tests.driving import a_rule
from wayside.api import EventRule

_SIGNALS: list[tuple[str, dict[str, Any]]] = [
    *(
        ("number", {"stream": "s", "value": "msg.v", "over": over, "aggregate": aggregate})
        for aggregate, over in (("Max", "1s"), ("Min", "700ms"), ("Mean", "1500ms"), ("Sum", "3s"), ("Delta", "1s"),
                                ("First", "1s"), ("Rate", "1s"), ("StdDev", "1s"))
    ),
    ("number", {"stream": "s", "value": "msg.v"}),
    ("number", {"stream": "s", "over": "1s", "aggregate": "Count"}),
    ("number", {"stream": "s", "value": "msg.v", "aggregate": "Previous"}),
    ("number", {"stream": "s", "value": "msg.v * parameters.f"}),
    ("number", {"stream": "s", "value": "msg.big", "over": "1s", "aggregate": "Max"}),
    ("truth", {"stream": "s", "value": "msg.v > 3", "over": "1s", "aggregate": "Any"}),
    ("truth", {"stream": "s", "value": "msg.v > 1", "over": "1s", "aggregate": "All"}),
    ("truth", {"stream": "s", "value": "has(msg.w)"}),
    ("list", {"stream": "s", "value": "msg.v", "over": "1s", "aggregate": "Distinct"}),
    ("number", {"stream": "p", "value": "msg.q.w * 2", "over": "1s", "aggregate": "Max", "where": "msg.gear == 'D'"}),
    ("number", {"stream": "p", "value": "msg.q.w / msg.q.z"}),
    ("number", {"stream": "p", "value": "msg.q.w", "where": "msg.on", "aggregate": "Previous"}),
    ("number", {"stream": "p", "value": "msg.q.w", "over": "900ms", "aggregate": "First", "where": "msg.q.w > 1"}),
    ("number", {"stream": "p", "over": "2s", "aggregate": "Count", "where": "msg.q.w > 2"}),
    ("number", {"stream": "p", "aggregate": "Age"}),
    ("number", {"stream": "p", "value": "sample.size * 0.05"}),
    ("truth", {"stream": "p", "value": "msg.on"}),
    ("text", {"stream": "p", "value": "msg.gear"}),
    ("list", {"stream": "p", "value": "msg.q"}),
    ("number", {"stream": "o", "value": "item.v"}),
    ("number", {"stream": "o", "value": "item.v + before.v"}),
    ("number", {"stream": "s", "value": "msg.v", "client": "c1"}),
    ("number", {"stream": "o", "value": "item.v - msg.f", "over": "1s", "aggregate": "Min", "client": "c2"}),
    ("text", {"stream": "p", "value": "msg.gear", "client": "c0", "where": "msg.on"}),
    ("number", {"stream": "s", "value": "msg.v - before.v", "over": "1s", "aggregate": "Max"}),
    ("number", {"stream": "p", "value": 'at(position, "yard").distance'}),
    ("number", {"stream": "p", "value": 'at(position, "lane").heading - at(positionBefore, "lane").along'}),
    ("truth", {"stream": "p", "value": 'at(position, "yard").inside || at(position, "lane").across > 0'}),
    ("truth", {"stream": "p", "value": "has(before.q)", "where": "before.gear != msg.gear"}),
    ("number", {"stream": "o", "value": "item.v * msg.f - item.at[0]", "over": "1s", "aggregate": "Max"}),
    ("number", {"stream": "o", "over": "2s", "aggregate": "Count", "where": "item.v > 1"}),
    ("text", {"stream": "o", "value": "[item].map(i, i.gear)[0]"}),
]  # fmt: skip

POSITION = {"x": "msg.q.w", "y": "msg.q.z", "yaw": "msg.q.w / 3", "speed": "msg.q.z"}
PLACES = [
    {"name": "yard", "area": [[0, -1], [3, -1], [3, 1], [1, 0.1]]},
    {"name": "lane", "line": [[0, 0], [2.5, 1], [2.5, 9]], "width": 1},
]

_FORMS = {
    "number": ["{} > 1", "{} < 2", "{} * 2 >= 5", "{} > parameters.f", "({0} > 1 ? {0} : 0 - {0}) > 2",
               "{} in [1, 2, 3]",
               "{} > (labels.kind == 'bus' ? 1 : 2)", "client == 'c1' || {} > 2", "[{}, 2.0].exists(x, x > 3)",
               "size(streams) > 1 && {} > 1", "[{}].exists(x, 1.0 / x < 0.0)"],
    "truth": ["{}", "!{}"],
    "text": ["{} == 'D'", "{} != 'R'", "{} + 'x' == 'Dx'"],
    "list": ["size({}) > 1", "{}[0] > 1"],
}  # fmt: skip

_DERIVED: list[dict[str, Any]] = [
    {"of": "{}"}, {"of": "{}", "lag": "300ms"}, {"of": "{}", "over": "1s", "aggregate": "Max"},
    {"of": "{} > 2", "over": "700ms", "aggregate": "Any"}, {"of": "[{}, 2.0]", "lag": "100ms", "aggregate": "Previous"},
    {"of": "{} > 1 ? 'a' : 'b'", "lag": "100ms", "aggregate": "First"},
    {"of": "{}", "over": "1s", "lag": "500ms", "aggregate": "Distinct"},
    {"of": "{}", "over": "1s", "aggregate": "Quantile", "quantile": 0.5},
    {"of": "{}", "over": "Episode", "aggregate": "Max"}, {"of": "{} > 1", "over": "Episode", "aggregate": "All"},
    {"of": "{}", "over": "Episode", "aggregate": "Mean"}, {"over": "Episode", "aggregate": "Age"},
]  # fmt: skip
"""Signals over what conditions see."""

_OVER: list[tuple[dict[str, Any], str]] = [
    ({"aggregate": "Count", "over": "2s", "samples": "Ends", "client": "c1"}, "over > 0"),
    ({"aggregate": "Active"}, "over"), ({"aggregate": "Active"}, "!over"),
    ({"aggregate": "Count", "over": "2s"}, "over > 1"), ({"aggregate": "Age"}, "over < 0.8"),
    ({"aggregate": "Last", "value": "msg.values.g0"}, "over > 1.5"),
    ({"aggregate": "Any", "value": "msg.subject == 'c1'", "over": "3s"}, "over"),
    ({"aggregate": "Age", "where": "has(msg.values.g0)"}, "over > 0.5"),
    ({"aggregate": "Distinct", "value": "msg.subject", "over": "3s"}, "size(over) > 0"),
]  # fmt: skip
"""Signals over the episodes of another rule."""

_FOLDS = [
    "members.exists(m, {})", "members.all(m, {})", "members.exists_one(m, {})",
    "size(members.filter(m, {})) >= 2", "members.filter(m, {}).size() * 2 == 4", "size(members) > 1",
    "size(members) < parameters.f", "members.exists(m, ({}) && m.client == members[0].client)",
    "members.filter(m, {}).map(m, m.client)[0] == 'c1'",
]  # fmt: skip


def _condition(random: Random, names: list[tuple[str, str]], each: bool) -> str:
    def simple() -> str:
        name, kind = random.choice(names)
        if each and kind == "number" and random.random() < 0.4:
            return f"{name} > e.limit"
        return random.choice(_FORMS[kind]).format(name)

    text = simple()
    for _ in range(random.choice([0, 0, 1, 2])):
        text = f"{random.choice(['!(', '('])}{text}) {random.choice(['&&', '||'])} ({simple()})"
    return text


def _members(random: Random, names: list[tuple[str, str]]) -> str:
    simple = [random.choice(_FORMS[kind]).format(name) for name, kind in names]
    return random.choice(["true", "client != 'c2'", "'p' in streams", *simple, *simple])


def _fleet_condition(random: Random, names: list[tuple[str, str]], each: bool) -> str:
    """Loops that columns take, and others."""

    def simple() -> str:
        name, kind = random.choice(names)
        item = f"m.{name}"
        if each and kind == "number" and random.random() < 0.4:
            predicate = f"{item} > e.limit"
        else:
            predicate = random.choice(_FORMS[kind]).format(item)
            for variable in ("labels.", "parameters.", "client ", "streams"):
                predicate = predicate.replace(variable, f"m.{variable}")
        return random.choice(_FOLDS).format(predicate)

    text = simple()
    for _ in range(random.choice([0, 0, 1, 2])):
        text = f"{random.choice(['!(', '('])}{text}) {random.choice(['&&', '||'])} ({simple()})"
    return text


def a_random_rule(random: Random, number: int, kind: str) -> EventRule:
    spec = _a_random_spec(random, number, kind)
    if random.random() < 0.35:
        _derive(random, spec, kind)
    return a_rule(f"r{number}", **spec)


def _derive(random: Random, spec: dict[str, Any], kind: str) -> None:
    """Give the rule a signal over what its conditions see."""
    signal = {"name": "d", **random.choice(_DERIVED)}
    name = {"pairs": random.choice(["distance", "b.g0"]), "fleet": "double(size(members))"}.get(kind, "g0")
    if "of" in signal:
        signal["of"] = signal["of"].format(name)
    spec["signals"].append(signal)
    if signal.get("over") != "Episode":
        spec["when"] = (
            f"({spec['when']}) {random.choice(['&&', '||', '||'])} {random.choice(_FORMS['number'][:3]).format('d')}"
        )
    for action in spec.get("actions", []):
        action["deploy"]["parameters"] = {**action["deploy"]["parameters"], "d": "${d}"}


def _a_random_spec(random: Random, number: int, kind: str) -> dict[str, Any]:
    signals, names = [], []
    for at in range(random.choice([1, 1, 2])):
        what, signal = random.choice(_SIGNALS)
        signals.append({"name": f"g{at}", **signal})
        names.append((f"g{at}", what))
    each = kind in ("client", "fleet") and random.random() < 0.2
    spec: dict[str, Any] = {"signals": signals, "parameters": {"f": 1.5}}
    spec["evaluation"] = random.choice([{"every": every} for every in ("100ms", "100ms", "300ms", "1s")])
    if each:
        spec["each"] = {"as": "e", "of": [{"name": "a", "limit": 1.0}, {"name": "b", "limit": 2.5}]}
        signals.append({"name": "ge", "stream": "s", "value": "msg.v - e.limit", "over": "500ms", "aggregate": "Max"})
        names.append(("ge", "number"))
    spec["when"] = _condition(random, names, each)
    if kind == "over":
        signal, form = random.choice(_OVER)
        signals.append({"name": "over", "ruleName": f"r{random.randrange(number)}", **signal})
        spec["when"] = random.choice(["{1}", "{1} && ({0})", "({0}) || {1}"]).format(spec["when"], form)
    if kind == "pairs":
        position = {"stream": "p", "x": "msg.q.w", "y": "msg.q.z", "maxAge": "1s"}
        if random.random() < 0.3:
            position = {"stream": "o", "x": "item.v", "y": "msg.f"}
        spec["scope"] = {"pairs": {"position": position, "within": 3}}
        condition = spec["when"]
        for name, _ in names:
            condition = condition.replace(name, f"a.{name}")
        for variable in ("labels.", "client ", "streams"):
            condition = condition.replace(variable, f"b.{variable}")
        spec["when"] = random.choice(["distance < 1.5", "closingSpeed > 0.1", f"distance < 2 && ({condition})"])
        if position["stream"] == "p" and random.random() < 0.4:
            position = {"stream": "p", "maxAge": "1s"}
            spec["scope"]["pairs"]["position"] = position
            spec["when"] = random.choice(
                [
                    'at(a.position, "yard").inside || at(b.position, "lane").along > 1',
                    "seenFrom(a, b).ahead > 0.5 || seenFrom(b, a).speedLeft > 0.2",
                ]
            )
        if random.random() < 0.5:
            spec["until"] = "distance > 2"
        return spec
    if kind == "fleet":
        spec["when"] = _fleet_condition(random, names, each)
        spec["scope"] = {"fleet": {"members": _members(random, names)}}
        if random.random() < 0.5:
            spec["until"] = _fleet_condition(random, names, each)
        if random.random() < 0.3:
            sources = {"sources": "${members.map(m, m.client)}"}
            spec["actions"] = [{"name": "d", "deploy": {"templateName": "t", "parameters": sources, "follow": True}}]
        for field, values in (("for", ("200ms", "1s")), ("cooldown", ("500ms",)), ("unknownTimeout", ("300ms", "1s"))):
            if random.random() < 0.3:
                spec[field] = random.choice(values)
        return spec
    if random.random() < 0.1:
        spec["evaluation"] = random.choice([{"onSample": "s"}, {"onSample": "p"}, {"onDemand": True}])
    if random.random() < 0.3:
        spec["evaluation"] = {**spec["evaluation"], "priority": random.choice([1, 2])}
    if random.random() < 0.6:
        spec["until"] = _condition(random, names, each)
    for field, share, values in (
        ("for", 0.5, ("200ms", "500ms", "1s")),
        ("cooldown", 0.3, ("500ms", "2s")),
        ("unknownTimeout", 0.5, ("300ms", "1s")),
        ("maxEpisodesPerHour", 0.2, (1, 2)),
    ):
        if random.random() < share:
            spec[field] = random.choice(values)
    if random.random() < 0.25:
        where = [*(form.format(*names[0]) for form in ("client != 'c2'", "labels.kind == 'bus'")), "'p' in streams"]
        spec["scope"] = {"client": {"where": random.choice(where)}}
    if random.random() < 0.4:
        parameters = {"x": "${g0}", "c": "${client}"}
        deploy = {"templateName": "t", "parameters": parameters, **random.choice([{}, {"follow": True}])}
        spec["actions"] = [{"name": "d", "deploy": deploy}]
    return spec
