"""A feed delivers each message of a source to the streams of its key, and matches a key against the patterns once."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from detector.sources.base import Feed, Put
from tests.driving import a_stream
from wayside.api.stream import Stream
from wayside.keys import KeyPattern

STREAMS = [
    Stream.model_validate(a_stream("pose")),
    Stream.model_validate(a_stream("all", key="vehicles/${client:*}/**")),
]


def test_a_key_is_matched_once_with_or_without_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    delivered: list[tuple[tuple[str, ...], str, bytes]] = []
    unrouted: list[str] = []
    matched: list[tuple[str, str]] = []
    match = KeyPattern.match

    def putter(*streams: str) -> Put:
        def put(messages: Sequence[tuple[str, bytes]]) -> None:
            delivered.extend((streams, *message) for message in messages)

        return put

    def watched(pattern: KeyPattern, key: str) -> dict[str, str] | None:
        matched.append((pattern.text, key))
        return match(pattern, key)

    monkeypatch.setattr(KeyPattern, "match", watched)
    feed = Feed(STREAMS, putter, unrouted.append)
    keys = ["vehicles/a/pose", "vehicles/a/speed", "trains/a/pose"]
    for payload in (b"first", b"second"):
        for key in keys:
            feed.put(key, payload)
    assert delivered == [
        (streams, key, payload)
        for payload in (b"first", b"second")
        for streams, key in ((("pose", "all"), keys[0]), (("all",), keys[1]))
    ]
    assert unrouted == ["trains/a/pose"] * 2
    assert feed.messages == 4
    assert matched == [(each.key, key) for key in keys for each in STREAMS]
