"""The text of an event is byte-identical to an encoded CloudEvent; ids are base32 of a SHA-256."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.engine.episodes.episodes import EndReason
from detector.engine.episodes.events import Event
from detector.engine.episodes.plain import plain, plain_text
from detector.engine.episodes.record import EpisodeRecord, episode_id
from tests.driving import START

YEAR_1 = -62_135_596_800 * 10**9
YEAR_10000 = 253_402_300_800 * 10**9

ODD = st.sampled_from(["\u2028", "\x7f", "\x00", "\ud800", '"', "\\", "/", "\n", "ä", "\U0001f697", "<", "é"])
TEXTS = st.text(st.characters(exclude_categories=()), max_size=8) | ODD
TIMES = st.integers(YEAR_1, YEAR_10000 - 1) | st.integers(START, START + 3 * 10**9)
BEYOND = st.sampled_from([YEAR_1 - 1, YEAR_10000, -(10**40), 10**40])


class Number(float):
    """Prints itself in a way that JSON does not have."""

    def __repr__(self) -> str:
        return "a number"


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([2**53 + 1, -(2**64), 10**30, 1e16, 1e22, 1e-7, -0.0, 5e-324])
    | st.floats()
    | st.floats().map(Number)
    | TEXTS
    | st.sampled_from(EndReason)
)
KEYS = TEXTS | st.integers(-2, 2) | st.booleans() | st.sampled_from(["1", "True", "None"]) | st.none()
NESTED: st.SearchStrategy[Any] = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(KEYS, inner, max_size=4)
        | st.dictionaries(TEXTS, inner, max_size=4).map(MappingProxyType)
    ),
    max_leaves=10,
)
VALUES = st.dictionaries(TEXTS, NESTED, max_size=4)
UNKNOWN_TO_JSON = st.sampled_from([b"bytes", {1}, object(), 1j])


FINITE = st.floats(allow_nan=False, allow_infinity=False)
"""Only values may have what JSON does not have: of two errors, the first depends on the order of the work."""


def events(times: st.SearchStrategy[int], values: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[Event]:
    return st.builds(
        Event,
        holder=TEXTS,
        episode=st.builds(
            EpisodeRecord,
            id=TEXTS,
            rule=TEXTS,
            subject=TEXTS,
            clients=st.lists(TEXTS, max_size=3).map(tuple),
            element=st.none() | TEXTS,
            onset_time=times,
            start_time=times,
            values=values,
            classification=st.none() | st.dictionaries(TEXTS, st.lists(TEXTS, max_size=2) | FINITE, max_size=2),
        ),
        values=values,
        end_time=st.none() | times,
        reason=st.none() | st.sampled_from(EndReason),
        models=st.dictionaries(TEXTS, TEXTS, max_size=2),
        dry_run=st.booleans(),
        traceparent=st.none() | TEXTS,
        recording=st.none() | TEXTS,
    )


def reference_time(ns: int) -> str:
    seconds, fraction = divmod(ns, 10**9)
    try:
        whole = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, OSError) as error:
        raise ValueError("no such time") from error
    return f"{whole.year:04}-{whole:%m-%dT%H:%M:%S}.{fraction:09}Z"


def reference_plain(value: Any) -> Any:
    def is_null(value: Any) -> bool:
        return value is None or (isinstance(value, float) and not math.isfinite(value))

    if isinstance(value, Mapping):
        return {str(key): reference_plain(child) for key, child in value.items() if not is_null(child)}
    if isinstance(value, list | tuple):
        return [None if is_null(item) else reference_plain(item) for item in value]
    return value


def reference_document(event: Event) -> dict[str, Any]:
    """The CloudEvent as a dict, key by key."""
    data: dict[str, Any] = {
        "rule": event.episode.rule,
        "episode": event.episode.id,
        "subjects": list(event.episode.clients),
        **({} if event.episode.element is None else {"element": event.episode.element}),
        "onsetTime": reference_time(event.episode.onset_time),
        "startTime": reference_time(event.episode.start_time),
    }
    if event.end_time is not None and event.reason is not None:
        data["endTime"] = reference_time(event.end_time)
        data["reason"] = event.reason.value
    data["values"] = reference_plain(event.values)
    if event.models:
        data["models"] = dict(event.models)
    if event.episode.classification is not None:
        data["classification"] = dict(event.episode.classification)
    if event.dry_run:
        data["dryRun"] = True
    return {
        "specversion": "1.0",
        "id": f"{event.episode.id}.{'started' if event.reason is None else 'ended'}",
        "source": f"/detectors/{event.holder}",
        "type": f"dev.wayside.event.{'started' if event.reason is None else 'ended'}",
        "subject": event.episode.subject,
        "time": reference_time(event.episode.start_time if event.end_time is None else event.end_time),
        "datacontenttype": "application/json",
        **({} if event.traceparent is None else {"traceparent": event.traceparent}),
        **({} if event.recording is None else {"recording": event.recording}),
        "data": data,
    }


def reference_text(event: Event) -> str:
    return compact(reference_document(event))


def compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def outcome(make: Callable[[], str]) -> str | type[Exception]:
    try:
        return make()
    except (TypeError, ValueError) as error:
        return type(error)


@given(events(TIMES, VALUES))
def test_the_text_equals_the_encoded_cloud_event(event: Event) -> None:
    assert outcome(event.to_json) == outcome(lambda: reference_text(event))


@given(events(TIMES | BEYOND, VALUES))
def test_a_time_out_of_range_raises_the_same_error(event: Event) -> None:
    assert outcome(event.to_json) == outcome(lambda: reference_text(event))


@given(events(TIMES, st.dictionaries(TEXTS, UNKNOWN_TO_JSON | st.lists(UNKNOWN_TO_JSON, max_size=1), max_size=2)))
def test_a_value_without_json_form_raises_the_same_error(event: Event) -> None:
    assert outcome(event.to_json) == outcome(lambda: reference_text(event))


@given(events(TIMES, VALUES))
def test_actions_get_the_cloud_event_of_the_text(event: Event) -> None:
    episode = msgspec.structs.replace(event.episode, classification={"timeSensitivity": ["Immediate"]})
    event = msgspec.structs.replace(event, episode=episode)
    document = event.cloud_event()
    assert compact(document) == reference_text(event)
    assert document == json.loads(reference_text(event))


@given(VALUES)
def test_plain_values_and_their_text_agree(values: dict[str, Any]) -> None:
    made, expected = plain(values), reference_plain(values)
    assert compact(made) == compact(expected)
    assert plain_text(values) == compact(expected)


@given(st.text(), st.text(), st.text(), st.integers())
def test_an_episode_id_is_base32_of_a_sha256(holder: str, rule: str, subject: str, start: int) -> None:
    digest = hashlib.sha256("\0".join((holder, rule, subject, str(start))).encode()).digest()
    assert episode_id(holder, rule, subject, start) == base64.b32encode(digest[:10]).decode().lower()


def test_an_episode_keeps_its_id_from_version_to_version() -> None:
    assert episode_id("town", "close", "car1+car2", START) == "op6kpoq5iwop7hyd"


def test_events_with_the_same_fields_are_equal_and_none_can_be_changed() -> None:
    one, other = (
        Event("h", EpisodeRecord("e", "r", "car", ("car",), None, START, START, {}, None), {"v": math.nan})
        for _ in range(2)
    )
    assert one == other
    assert one != msgspec.structs.replace(other, dry_run=True)
    with pytest.raises(AttributeError, match="immutable"):
        one.dry_run = True  # type: ignore[misc]
    with pytest.raises(AttributeError, match="immutable"):
        one.episode.rule = "another"  # type: ignore[misc]
