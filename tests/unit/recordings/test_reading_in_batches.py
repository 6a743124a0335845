"""Reading in bulk gives what reading message by message gives, in the same order and with the same errors."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from zstandard import ZstdError

from detector.engine.samples.sample import Arrival
from detector.replay import batches, json_lines, mcap_chunks
from detector.replay.batches import (
    MAXIMUM_BYTES,
    MAXIMUM_MESSAGES,
    Batch,
    Channel,
    batched,
    merged_batches,
    messages_of,
)
from detector.replay.message import DAMAGE, Message, RecordingError, Truncation
from detector.replay.recordings import open_recordings
from detector.replay.routing import MessageRouter
from tests.recorded import arrivals_of, messages_in
from wayside.api.stream import Encoding, Stream

Sent = tuple[int, str, bytes]
"""Time, topic and payload."""

FILES = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

SENT = st.lists(
    st.tuples(st.integers(0, 12), st.sampled_from(["/a", "/b", "/c"]), st.binary(max_size=40)), min_size=1, max_size=60
)


@st.composite
def mcap_options(draw: st.DrawFn) -> dict[str, object]:
    """Small chunks, so that they overlap."""
    return {
        "chunk_size": draw(st.sampled_from([50, 200, 1000])),
        "compression": draw(st.sampled_from(CompressionType)),
        "index_types": draw(st.sampled_from([IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE])),
        "enable_crcs": draw(st.booleans()),
    }


def write(path: Path, sent: Sequence[Sent], **options: object) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **options)  # type: ignore[arg-type]
        writer.start()
        channels: dict[str, int] = {}
        for number, (time, topic, payload) in enumerate(sent):
            if topic not in channels:  # so some are first defined inside of later chunks
                channels[topic] = writer.register_channel(topic, "raw", 0)
            writer.add_message(channels[topic], time, payload, time, number)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def by_the_library(path: Path, topics: set[str]) -> tuple[list[Sent], str]:
    """What the library mcap reads message by message, and why it stops before the end."""
    found: list[Sent] = []
    with path.open("rb") as file:
        try:
            reader = SeekingReader(file, validate_crcs=True, record_size_limit=1 << 30)
            summary = reader.get_summary()
            if summary is None or any(channel.topic in topics for channel in summary.channels.values()):
                for _, channel, message in reader.iter_messages(topics):
                    found.append((message.log_time, channel.topic, message.data))
        except (*DAMAGE, McapError, ZstdError) as error:
            return found, str(error) or type(error).__name__
    return found, ""


def in_bulk(path: Path, topics: set[str]) -> tuple[list[Sent], str]:
    """The same, as Wayside reads it."""
    found: list[Sent] = []
    try:
        for message in messages_in([path], lambda key: f"/{key}" in topics):
            found.append((message.time, f"/{message.key}", message.payload))
    except RecordingError as error:
        return found, str(error).partition("damaged (")[2].partition("): repair")[0]
    return found, ""


TOPICS = st.sampled_from([{"/a", "/b", "/c"}, {"/b"}, {"/a", "/c"}])


@FILES
@given(sent=SENT, options=mcap_options(), topics=TOPICS)
def test_chunks_that_overlap_are_read_in_the_order_of_times_and_places(
    tmp_path: Path, sent: list[Sent], options: dict[str, object], topics: set[str]
) -> None:
    path = write(tmp_path / "drive.mcap", sent, **options)
    in_order = sorted((each for each in sent if each[1] in topics), key=lambda each: each[0])
    assert in_bulk(path, topics)[0] == in_order == by_the_library(path, topics)[0]


@FILES
@given(sent=SENT, options=mcap_options(), topics=TOPICS, data=st.data())
def test_a_damaged_byte_anywhere_has_the_same_error_and_no_other_messages_before_it(
    tmp_path: Path, sent: list[Sent], options: dict[str, object], topics: set[str], data: st.DataObject
) -> None:
    path = write(tmp_path / "drive.mcap", sent, **options)
    content = bytearray(path.read_bytes())
    # The magic at both ends, and where the summary begins, decide whether the file has an index at all.
    for place in data.draw(st.lists(st.integers(8, len(content) - 38), min_size=1, max_size=3)):
        content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    (found, error), (expected, its_error) = in_bulk(path, topics), by_the_library(path, topics)
    assert error == its_error
    # Where the damage is in an index, how many messages come before the error depends on which chunk is opened first.
    both = min(len(found), len(expected)) if error else None
    assert found[:both] == expected[:both]


@FILES
@given(sent=SENT, options=mcap_options(), data=st.data())
def test_wrong_message_indexes_are_not_trusted(
    tmp_path: Path, sent: list[Sent], options: dict[str, object], data: st.DataObject
) -> None:
    path = write(tmp_path / "drive.mcap", sent, **{**options, "index_types": IndexType.ALL})
    with path.open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    content = bytearray(path.read_bytes())
    for index in summary.chunk_indexes:
        begin = index.chunk_start_offset + index.chunk_length
        for place in data.draw(st.lists(st.integers(begin, begin + index.message_index_length - 1), max_size=4)):
            content[place] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    assert in_bulk(path, {"/a", "/b", "/c"}) == (sorted(sent, key=lambda each: each[0]), "")


@FILES
@given(sent=SENT, options=mcap_options(), share=st.floats(0, 1))
def test_a_file_truncated_anywhere_is_read_up_to_the_cut(
    tmp_path: Path, sent: list[Sent], options: dict[str, object], share: float
) -> None:
    path = write(tmp_path / "drive.mcap", sent, **options)
    content = path.read_bytes()
    path.write_bytes(content[: 8 + int(share * (len(content) - 8))])
    cuts: list[Truncation] = []
    found = [(each.time, f"/{each.key}", each.payload) for each in messages_in([path], on_cut=cuts.append)]
    assert found == sorted(sent[: len(found)], key=lambda each: each[0])
    assert [cut.messages for cut in cuts] == [len(found)] or (cuts == [] and len(found) == len(sent))


def test_valid_message_indexes_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a chunk was gone through record by record")

    monkeypatch.setattr(mcap_chunks, "breakup_chunk", refuse)
    sent = [(number // 3, f"/{number % 5}", bytes(number % 7)) for number in range(1000)]
    path = write(tmp_path / "drive.mcap", sent, chunk_size=500)
    assert [(each.time, f"/{each.key}", each.payload) for each in messages_in([path])] == sent


def test_a_batch_has_bounds(tmp_path: Path) -> None:
    sent = [(number, "/a", b"") for number in range(10_000)]
    sent += [(20_000 + number, "/a", bytes(MAXIMUM_BYTES // 3)) for number in range(10)]
    path = write(tmp_path / "drive.mcap", sent, compression=CompressionType.NONE)
    lines = tmp_path / "drive.jsonl"
    lines.write_text("".join(f'{{"t":{n},"key":"a","value":1}}\n' for n in range(10_000)))
    read = [*open_recordings([path]), *batched(messages_in([path]))]
    assert sum(len(batch.times) for batch in read) == 2 * len(sent)
    assert max(len(batch.times) for batch in read) <= MAXIMUM_MESSAGES
    assert max(sum(map(len, batch.payloads)) for batch in read) < MAXIMUM_BYTES * 4 / 3
    assert max(len(batch.times) for batch in open_recordings([lines])) < 3 * MAXIMUM_MESSAGES


def cut_at(times: Sequence[int], name: str, places: set[int]) -> Iterator[Batch]:
    """Messages on the key `name`, in batches that end at these places and where time goes back."""
    channel = Channel(name, "raw", None)
    begin = 0
    for at in range(1, len(times) + 1):
        if at == len(times) or at in places or times[at] < times[at - 1]:
            payloads = [str(number).encode() for number in range(begin, at)]
            yield Batch(list(times[begin:at]), [channel] * (at - begin), payloads)
            begin = at


@settings(max_examples=150, deadline=None)
@given(
    recordings=st.lists(
        st.tuples(st.lists(st.integers(-3, 9), max_size=25), st.sets(st.integers(0, 25)), st.booleans()), max_size=4
    )
)
def test_several_recordings_are_merged_as_message_by_message(
    recordings: list[tuple[list[int], set[int], bool]],
) -> None:
    given = [
        (sorted(times) if in_order else times, f"{number}", places)
        for number, (times, places, in_order) in enumerate(recordings)
    ]
    expected = heapq.merge(*(messages_of(cut_at(*each)) for each in given), key=attrgetter("time"))
    assert list(messages_of(merged_batches([cut_at(*each) for each in given]))) == list(expected)


LINE = st.one_of(
    st.just("\n"),
    st.just("\n"),
    st.just('{"t": 7, "key": "a"\n'),
    st.just('{"t": 7, "key": "", "value": 1}\n'),
    st.just('{"t": 7, "key": "a", "value": "\xff"}\n'),
    st.just("nonsense"),
    st.just('{"t": 1, "key": "a", "value": 1}\n'),
)
"""A line that may be wrong, or have no end."""


def lines_read(path: Path, block: int) -> tuple[list[Message], str, list[Truncation]]:
    found: list[Message] = []
    cuts: list[Truncation] = []
    with mock.patch.object(json_lines, "_BLOCK", block):
        try:
            for message in messages_in([path], lambda key: key != "unwanted", cuts.append):
                found.append(message)
        except RecordingError as error:
            return found, str(error), cuts
    return found, "", cuts


@FILES
@given(
    steps=st.lists(st.tuples(st.integers(0, 2), st.sampled_from(["a", "/b", "unwanted"])), min_size=1, max_size=30),
    wrong=st.dictionaries(st.integers(1, 30), LINE, max_size=3),
    block=st.sampled_from([60, 200, 1 << 18]),
)
def test_blocks_of_lines_read_as_line_by_line(
    tmp_path: Path, steps: list[tuple[int, str]], wrong: dict[int, str], block: int
) -> None:
    time, lines = 3, []
    for number, (step, key) in enumerate(steps):
        time += step
        lines.append(json.dumps({"t": time, "key": key, "value": number}) + "\n")
        lines.append(wrong.get(number, ""))
    path = tmp_path / "drive.jsonl"
    path.write_text("".join(lines), encoding="latin-1")
    assert lines_read(path, block) == lines_read(path, 1)


RAW = Stream(name="raw", key="${client:*}/raw", encoding=Encoding.RAW)
JSON = Stream(name="json", key="${client:*}/json", encoding=Encoding.JSON)


def test_messages_before_an_error_are_delivered() -> None:
    good = [Message(number, f"car/{'raw' if number % 2 else 'other'}", b"x", "raw", None) for number in range(10)]

    def broken() -> Iterator[Message]:
        yield from good
        raise RecordingError("damaged")

    for messages, error in ((broken(), "damaged"), ([*good, Message(10, "car/json", b"1", "cbor", None)], "cbor")):
        arrivals: list[Arrival] = []
        with pytest.raises(RecordingError, match=error):
            arrivals.extend(arrivals_into(arrivals, MessageRouter([RAW, JSON]), messages))
        assert arrivals == [Arrival(number, "raw", "car/raw", b"x") for number in (1, 3, 5, 7, 9)]


def arrivals_into(found: list[Arrival], router: MessageRouter, messages: Iterable[Message]) -> list[Arrival]:
    """Puts the arrivals into `found` up to an error."""
    for arrival in arrivals_of(router, messages):
        found.append(arrival)
    return []


@settings(max_examples=150, deadline=None)
@given(
    steps=st.lists(st.sampled_from([0, 0, 0, 1, batches.PAUSE, batches.PAUSE + 1]), max_size=60),
    cuts=st.sets(st.integers(0, 60)),
    most=st.integers(1, 8),
    step=st.integers(1, 5),
)
def test_a_recording_is_cut_at_pauses_and_where_time_continues(
    steps: list[int], cuts: set[int], most: int, step: int
) -> None:
    arrivals = [Arrival(sum(steps[: at + 1]), "s", "k", b"") for at in range(len(steps))]
    places = sorted({0, len(arrivals), *(cut for cut in cuts if cut < len(arrivals))})
    pieces = [arrivals[begin:end] for begin, end in pairwise(places)]
    with mock.patch.object(batches, "_ARRIVALS", most), mock.patch.object(batches, "_STEP", step):
        found = list(batches.parts_of(pieces))
    assert [arrival for part in found for arrival in part] == arrivals
    assert all(found)
    for part in found:
        assert all(after.received - before.received <= batches.PAUSE for before, after in pairwise(part))
        assert len({arrival.received for arrival in part[: -most - step]}) <= 1  # longer only by what has one time
    for before, after in pairwise(found):
        assert before[-1].received < after[0].received


def test_a_part_has_bytes_within_bounds() -> None:
    payload = bytes(1 << 20)
    arrivals = [Arrival(number, "image", "k", payload) for number in range(200)]
    found = list(batches.parts_of(arrivals[at : at + 8] for at in range(0, 200, 8)))
    assert sum(map(len, found)) == 200
    assert max(map(len, found)) <= 72
