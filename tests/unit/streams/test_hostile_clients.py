"""Made-up names of vehicles cannot inject into keys, files or objects."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from detector.assembly import stream_readers
from tests.driving import Drive, a_detector, a_rule, arrival

RULE = a_rule("fast", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10")

HOSTILE = [
    "..", ".", "../../etc/passwd", "a/../b", "a b", "a\n", "a\x00", "${evil}", "$(reboot)", "%2e%2e", "a+b", "~fleet",
    "a~north", "<script>", "a'b", 'a"b', "a;b", "*", "**", "x" * 64, "", "ä", "\u202e", "a\\b", "-rf", "a,b=c",
]  # fmt: skip


ALLOWED = {*"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._:-"}


def is_harmless(name: str) -> bool:
    return bool(name) and set(name) <= ALLOWED and set(name) != {"."}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_made_up_name_appears_in_no_file_key_or_object(name: str) -> None:
    drive = Drive(a_detector(), RULE)
    drive.take(arrival(0.5, name, {"v": 20}), arrival(0.6, "car", {"v": 20}), until=1)
    assert "car" in drive.engine.clients
    assert [client for client in drive.engine.clients if not is_harmless(client)] == []
    for event in drive.events:
        assert set(event.key) <= ALLOWED | {"/", "%"}
        assert ".." not in event.key.split("/")


@given(st.text(max_size=80))
@example("..")
def test_any_text_is_accepted_only_as_a_valid_name(name: str) -> None:
    found = stream_readers(a_detector()).read_key("speed", f"vehicles/{name}/speed")
    assert found is None or is_harmless(found[0])
