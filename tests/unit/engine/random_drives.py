"""Random rules and streams for the test of equivalence: small, with many edge cases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

HALF = 500_000_000
"""Nanoseconds; all times are whole multiples, so that samples meet each other, ticks, window edges and timeouts."""

CLIENTS = ("a", "b", "c")

DURATIONS = ("0s", "500ms", "1s", "2s", "3s")

_BIG = 2**53 + 1

BROKEN = None
"""A message that cannot be read."""

_values = st.sampled_from(
    [
        0.0,
        -0.0,
        1.0,
        1.5,
        2.0,
        3.0,
        -1.0,
        10.0,
        _BIG,
        _BIG + 1,
        float("nan"),
        float("inf"),
        None,
        "x",
        "y",
        True,
        False,
        [1.0],
    ]
)

_messages = st.one_of(
    st.sampled_from([{"v": 2.0, "w": 1.0}, {"v": 0.0, "w": 1.0}, {"v": 2.0, "w": 0.0}]),
    st.sampled_from([{"v": 3.0, "w": 1.0}, {"v": 1.0, "w": 1.0}]),
    st.fixed_dictionaries({"v": st.sampled_from([0.0, 1.0, 1.5, 2.0, 3.0])}),
    st.fixed_dictionaries({"v": _values, "w": st.sampled_from([0.0, 1.0, 2.0])}),
    st.sampled_from([{}, {"w": 1.0}, BROKEN]),
)

_places = st.fixed_dictionaries(
    {
        "x": st.sampled_from([0.0, 0.0, 3.0, 4.0, 50.0, None]),
        "y": st.sampled_from([0.0, 0.0, 0.0, 4.0, float("nan")]),
        "v": st.sampled_from([0.0, 1.0, 2.0]),
    }
) | st.just(BROKEN)


@dataclass(frozen=True)
class Message:
    """One message: when it was sent, and with clock Data how much later than that it arrives; half seconds."""

    time: int
    delay: int
    client: str
    stream: str
    message: Any


@dataclass(frozen=True)
class Scene:
    """Rules, and what happens."""

    rules: dict[str, dict[str, Any]]
    messages: tuple[Message, ...]
    data: bool
    """Whether with clock Data."""
    lateness: int
    """With clock Data; half seconds."""
    gap: tuple[int, int] | None
    """With clock Wall, from when to when there are no ticks; half seconds."""
    count: int | None
    """How many samples of a client's speed are kept."""
    pose_bytes: int | None
    """How many bytes of a client's poses are kept."""
    all_bytes: int | None
    """With clock Wall, how many bytes are kept over all."""


_items = st.one_of(
    st.fixed_dictionaries(
        {
            "id": st.sampled_from(("a", "b", "o", "o", "p")),
            "v": st.sampled_from([0.0, 1.0, 2.0, 3.0]),
            "x": st.sampled_from([0.0, 3.0, 50.0]),
            "y": st.sampled_from([0.0, 4.0]),
        }
    ),
    st.sampled_from([{"id": "o", "v": "x"}, {"id": "p"}, {"id": "", "v": 1.0}, {"v": 1.0}, 1.0]),
)

_lists = st.builds(lambda n, items: {"n": n, "list": items}, st.sampled_from([0.0, 1.0]), st.lists(_items, max_size=3))

_message = st.builds(
    lambda time, delay, client, stream, value, place, items: Message(
        time, delay, client, stream, {"pose": place, "list": items}.get(stream, value)
    ),
    st.integers(1, 30),
    st.sampled_from([0, 0, 0, 1, 2, 4, 8]),
    st.sampled_from((*CLIENTS, "a", "a", "b")),
    st.sampled_from(["speed", "speed", "speed", "pose", "pose", "rare", "list", "list"]),
    _messages,
    _places,
    _lists | st.sampled_from([{}, {"list": 1.0}, BROKEN]),
)

POSITION = {"x": "msg.x", "y": "msg.y", "yaw": "msg.v", "speed": "msg.v"}
"""Of stream pose, as the Detector has it."""

PLACES: tuple[dict[str, Any], ...] = (
    {"name": "yard", "area": [[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]},
    {"name": "lane", "line": [[-1, 1], [3, 1], [3, 60]], "width": 2},
    {"name": "stop", "line": [[3, 0], [3, 5]]},
)

AT_A_SAMPLE = (
    'at(position, "yard").inside',
    'at(position, "yard").distance',
    'at(position, "lane").inside',
    'at(position, "lane").along',
    'at(position, "stop").across',
    'at(position, "lane").heading',
    "position.x + position.speed",
    'at(positionBefore, "stop").across > 0 && at(position, "stop").across <= 0',
)

AT_A_PAIR = (
    'at(a.position, "yard").inside && at(b.position, "lane").distance < 3',
    'at(b.position, "stop").along > 2 || !at(a.position, "lane").inside',
    "seenFrom(a, b).ahead > 0.5 || seenFrom(b, a).left >= 2",
    "seenFrom(a, b).speedAhead < 0 || seenFrom(b, a).speedLeft > 0.5",
    "seenFrom(a, b).heading < 30",
)

_WINDOWED = (
    "Min", "Max", "Mean", "Sum", "Count", "Rate", "Delta", "StdDev", "Quantile", "Slope", "All", "Any", "Distinct",
    "MinTime", "MaxTime",
)  # fmt: skip
_OF_A_SAMPLE = ("Last", "First", "Previous")


@st.composite
def _signal(draw: st.DrawFn, name: str, others: tuple[str, ...]) -> dict[str, Any]:
    aggregate = draw(st.sampled_from((*_OF_A_SAMPLE, *_WINDOWED, "Last", "Age")))
    of_rule = bool(others) and draw(st.booleans())
    signal: dict[str, Any] = {"name": name}
    if draw(st.integers(0, 3)) == 0:
        signal["client"] = draw(st.sampled_from(("a", "b", "o", "nobody")))
    if of_rule:
        signal["ruleName"] = draw(st.sampled_from(others))
        aggregate = draw(st.sampled_from(("Active", "Count", "Age", aggregate)))
        if aggregate == "Active":
            return {**signal, "aggregate": aggregate}
        if draw(st.booleans()):
            signal["samples"] = "Ends"
    else:
        signal["stream"] = draw(st.sampled_from(("speed", "speed", "speed", "pose", "rare", "list", "list")))
    signal["aggregate"] = aggregate
    if aggregate == "Quantile":
        signal["quantile"] = draw(st.sampled_from((0.0, 0.25, 0.5, 1.0)))
    if aggregate not in ("Count", "Age"):
        field = "msg.values.s" if of_rule else "msg.v"
        of_places = AT_A_SAMPLE if signal.get("stream") == "pose" else ()
        more = "sample.received > 0"
        if signal.get("stream") == "list":
            field = draw(st.sampled_from(("item.v", "item.v * 2 - msg.n", "item.v - before.v")))
            more = "[item.v].exists(v, v > 1)"
        elif not of_rule:
            field = draw(st.sampled_from((field, field, "msg.v - before.v", "before.v")))
            more = draw(st.sampled_from((more, "has(before.v)", "before == msg")))
        signal["value"] = draw(st.sampled_from((field, field, f"{field} > 1", more, *of_places)))
    if aggregate in _WINDOWED or draw(st.integers(0, 3)) == 0:
        signal["over"] = draw(st.sampled_from(("500ms", "1s", "2s", "3s", "5s")))
    if draw(st.integers(0, 3)) == 0:
        picked = ("msg.v > 0", "msg.w == 1", "before.v < msg.v")
        if signal.get("stream") == "list":
            picked = ("item.v > 0", "msg.n == 1", "before.v < item.v")
        if of_rule:
            picked = ("msg.values.s > 1", *(("msg.reason == 'Until'",) if "samples" in signal else ()))
        signal["where"] = draw(st.sampled_from(picked))
    return signal


_FORMS = (
    "{} > 1",
    "{} <= 1.5",
    "{} >= 2",
    "{} < 2",
    "{} > 0",
    "{} == 2",
    "{} != 0",
    "{} * 2 < 5",
    "{} == 'x'",
    "{}",
    "!{}",
    "size({}) > 1",
)


_OF_AN_EPISODE = ("Min", "Max", "MinTime", "MaxTime", "Mean", "Sum", "Count", "First", "Last", "All", "Any", "Age")


@st.composite
def _derived(draw: st.DrawFn, name: str, expressions: list[str]) -> dict[str, Any]:
    """A signal over what conditions see."""
    signal: dict[str, Any] = {"name": name, "of": draw(st.sampled_from(expressions))}
    if draw(st.integers(0, 3)) == 0:
        signal |= {"over": "Episode", "aggregate": draw(st.sampled_from(_OF_AN_EPISODE))}
        if signal["aggregate"] == "Age":
            del signal["of"]
        return signal
    signal["aggregate"] = draw(st.sampled_from((*_WINDOWED, *_OF_A_SAMPLE, "Last", "Any", "Max")))
    if signal["aggregate"] == "Quantile":
        signal["quantile"] = draw(st.sampled_from((0.0, 0.25, 0.5, 1.0)))
    if signal["aggregate"] in _WINDOWED or draw(st.booleans()):
        signal["over"] = draw(st.sampled_from(("500ms", "1s", "2s", "3s")))
    if draw(st.booleans()):
        signal["lag"] = draw(st.sampled_from(("500ms", "1s", "2s")))
    return signal


def _conditions(variables: list[str]) -> st.SearchStrategy[str]:
    """The distance is known to be a number, so conditions on strings and booleans would not compile."""
    simple = st.sampled_from(variables).flatmap(
        lambda name: st.sampled_from(_FORMS[:8] if name in _NUMBERS else _FORMS).map(lambda form: form.format(name))
    )
    joined = st.builds(lambda one, by, other: f"({one}) {by} ({other})", simple, st.sampled_from(["&&", "||"]), simple)
    return st.one_of(simple, joined)


_NUMBERS = ("distance", "closingSpeed")

_OF = ("{}", "{}", "{} > 1", "{} * 2", "{} == 'x'")

_POSITION = {"stream": "pose", "x": "msg.x", "y": "msg.y"}

_scopes = st.sampled_from(
    [
        None,
        None,
        {"client": {"where": '"speed" in streams'}},
        {"pairs": {"position": {"stream": "pose"}, "within": 5}},
        {"pairs": {"position": {**_POSITION, "maxAge": "500ms"}, "within": 10}},
        {"pairs": {"position": {**_POSITION, "maxAge": "2s"}, "within": 10}},
        {"pairs": {"position": {**_POSITION, "maxAge": "10s"}, "within": 10}},
        {"pairs": {"position": {"stream": "list", "x": "item.x", "y": "item.y"}, "within": 5}},
        {"pairs": {"position": {"stream": "rare", "x": "msg.w", "y": "msg.w"}, "within": 10}},
        {"pairs": {"position": _POSITION, "within": 10, "where": '"speed" in a.streams || distance < 5'}},
        {"pairs": {"position": _POSITION, "within": 10, "a": {"where": '"speed" in streams'}}},
        {
            "pairs": {
                "position": _POSITION,
                "within": 60,
                "a": {"where": "client != 'b'"},
                "b": {"where": '"pose" in streams'},
                "where": "closingSpeed < 50",
            }
        },
        {"fleet": {"members": "s > 1"}},
        {"fleet": {"members": '"speed" in streams'}},
    ]
)

_OF_A_FLEET = (
    "size(members) > 1",
    "size(members) > 0",
    "size(members) == 0",
    "members.exists(m, m.s > 2)",
    "members.all(m, m.s > 1)",
    "members.exists(m, m.client == 'a')",
)


@st.composite
def _rule(draw: st.DrawFn, others: tuple[str, ...]) -> dict[str, Any]:
    spec: dict[str, Any] = {"signals": [draw(_signal(name, others)) for name in ("s", "t")[: draw(st.integers(1, 2))]]}
    names = [signal["name"] for signal in spec["signals"]]
    scope = draw(_scopes)
    if scope is not None:
        spec["scope"] = scope
    if scope is not None and "pairs" in scope:
        names = [f"{role}.{name}" for name in names for role in "ab"] + ["distance", "closingSpeed"]
    fleet = scope is not None and "fleet" in scope
    expressions = (
        [*_OF_A_FLEET, "size(members)"]
        if fleet
        else [form.format(each) for each in names for form in (_OF[:-1] if each in _NUMBERS else _OF)]
    )
    if "distance" in names:
        expressions += ["timeToCollision(distance, closingSpeed)", "distance", "distance < 3"]
        if scope is not None and scope["pairs"]["position"]["stream"] == "pose":
            expressions += AT_A_PAIR
    known = []
    for name in ("d", "e")[: draw(st.sampled_from((0, 0, 1, 2)))]:
        signal = draw(_derived(name, [*expressions, *(form.format(each) for each in known for form in _OF)]))
        spec["signals"].append(signal)
        if signal.get("over") != "Episode":
            known.append(name)
    conditions = _conditions([*names, *known, *known])
    if scope is not None and scope.get("pairs", {}).get("position", {}).get("stream") == "pose":
        conditions = st.one_of(conditions, conditions, st.sampled_from(AT_A_PAIR))
    if fleet:
        conditions = st.one_of(st.sampled_from(_OF_A_FLEET), *([_conditions(known)] if known else []))
    if not fleet and draw(st.integers(0, 5)) == 0:
        one, other = draw(st.sampled_from(names)), draw(st.sampled_from(names))
        scales = {name.rpartition(".")[2]: draw(st.sampled_from((1.0, 0.5, 3.0))) for name in (one, other)}
        forms = [draw(st.sampled_from(_FORMS[:8])).format(name) for name in (one, other)]
        spec |= {"when": draw(st.sampled_from(("({}) && ({})", "!(({}) || ({}))", "{1}"))).format(*forms)}
        spec |= {"margin": scales}
        spec["signals"].append({"name": "near", "of": "margin", "over": "2s", "aggregate": "Max"})
        if draw(st.booleans()):
            spec["until"] = "near < -1"
    elif draw(st.integers(0, 4)) == 0:
        spec["each"] = {"as": "site", "of": [{"name": "n", "limit": 1.5}, {"name": "m", "limit": 0}]}
        alone = conditions
        conditions = st.builds(
            lambda one, other: f"({one}) && ({other})",
            alone,
            st.sampled_from(["site.limit > 1", "site.name == 'm'", "site.limit >= 0"]),
        )
    if "margin" not in spec:
        spec["when"] = draw(conditions)
        if draw(st.booleans()):
            spec["until"] = draw(conditions)
    for field in ("for", "cooldown", "unknownTimeout"):
        if draw(st.booleans()):
            spec[field] = draw(st.sampled_from(DURATIONS))
    if draw(st.integers(0, 3)):
        spec["evaluation"] = {"every": draw(st.sampled_from(("500ms", "1s", "1s", "2s")))}
    else:
        spec["evaluation"] = {"onSample": draw(st.sampled_from(("speed", "speed", "pose", "list")))}
    if scope is not None or "onSample" in spec["evaluation"]:
        # Whether a sample that has left the buffer was seen depends on who was looked at meanwhile.
        for signal in spec["signals"]:
            if signal.get("aggregate") == "Age":
                signal.pop("where", None)
    for signal in spec["signals"]:
        if signal.get("aggregate") == "Age" and "client" in signal:
            signal.pop("where", None)
    return spec


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """One to three rules, a few dozen messages, either clock."""
    rules: dict[str, dict[str, Any]] = {}
    for name in ("r", "q", "z")[: draw(st.integers(1, 3))]:
        rules[name] = draw(_rule(tuple(rules)))
    messages = draw(st.lists(_message, min_size=10, max_size=40))
    if draw(st.integers(0, 2)) == 0:  # else there is hardly ever a place of now and of a second ago
        messages += [Message(time, 0, client, "pose", draw(_places)) for time in range(1, 20, 2) for client in "ab"]
    if draw(st.booleans()):  # on a common grid: a and b move together, their values change, some twice
        speeds = draw(st.lists(st.sampled_from([0.0, 1.0, 1.5, 2.0, 3.0]), min_size=3, max_size=6))
        grid = [(time, client, stream) for time in range(1, 24) for client in "ab" for stream in ("pose", "speed")]
        twice = [each for each in grid if each[0] % len(speeds) == 0]
        messages += [
            Message(time, 0, client, stream, {"x": float(time), "y": 0.0, "v": speeds[number % len(speeds)]})
            for number, (time, client, stream) in enumerate(draw(st.sampled_from([grid, grid[::-1]])) + twice)
        ]
    if draw(st.integers(0, 2)) == 0:  # an object comes, is lost, and another comes under its name
        pause = draw(st.sampled_from([3, 5, 6, 8]))
        for time in (1, 2, 3, *(5 + pause + more for more in (0, 1, 2))):
            value = draw(st.sampled_from([1.0, 2.0, 3.0]))
            items = [{"id": name, "v": value, "x": 0.0, "y": 0.0} for name in ("o", "p")]
            messages.append(Message(time, 0, "a", "list", {"n": 0.0, "list": items}))
    data = draw(st.booleans())
    gap = None if data or draw(st.integers(0, 3)) else draw(st.tuples(st.integers(5, 15), st.integers(16, 25)))
    return Scene(
        rules,
        tuple(messages),
        data,
        draw(st.sampled_from((0, 1, 2, 2))),
        gap,
        draw(st.sampled_from((None, None, 1, 2, 4))),
        draw(st.sampled_from((None, None, 1, 500, 900))),
        None if data else draw(st.sampled_from((None, None, 1000, 3000))),
    )
