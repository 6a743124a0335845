"""The journal and the dead letters: recovery after a kill, unreadable entries, and bounds."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from detector.actions.notify.storage import DeadLetters
from detector.actions.store import action_store
from tests.http_servers import answers, endpoint, hangs
from tests.notifying import a_harness, an_episode

_KILLED = """
import sys
from pathlib import Path
from tests.notifying import a_harness, an_episode
harness = a_harness({"http": {"url": sys.argv[1], "timeout": "2m"}, "text": "x"}, state=Path(sys.argv[2]))
for number in range(20):
    harness.run(an_episode(f"e{number}", rendered={"text": f"number {number}"}))
print("accepted", flush=True)
sys.stdin.read()
"""


def test_events_journalled_before_a_kill_are_delivered_once_after_it(tmp_path: Path) -> None:
    with endpoint(hangs()) as there:  # no other request is in progress when the process ends
        process = subprocess.Popen(
            [sys.executable, "-c", _KILLED, there.url, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        assert process.stdout.readline() == b"accepted\n"
        there.received(1)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        there.requests.clear()
        there.behaviour = answers(200)
        harness = a_harness({"http": {"url": there.url}, "text": "x"}, state=tmp_path)
        events = [json.loads(request.body) for request in there.received(40)]
        harness.end()
    assert not harness.lost
    assert [event["id"] for event in events] == [
        f"e{number}.{what}" for number in range(20) for what in ("started", "ended")
    ]
    assert events[38]["data"]["notification"] == {"text": "number 19"}
    assert not list((tmp_path / "notify").iterdir())


def test_invalid_journal_entries_are_counted_and_removed(tmp_path: Path) -> None:
    store = action_store(tmp_path / "notify", "default_h_braking_notify", lambda *_: None)
    store.put("notice/e1.started", b"3")
    store.put("notice/e2.started", b"{}")
    store.close()
    with endpoint() as there:
        harness = a_harness({"http": {"url": there.url}}, state=tmp_path)
        assert harness.lost == {"journal entries that could not be read": 2}
        harness.end()
    assert not list((tmp_path / "notify").iterdir())


def test_an_unwritable_folder_is_reported_and_only_disables_the_journal(tmp_path: Path) -> None:
    (tmp_path / "notify").write_text("a file where a folder should be")
    with endpoint() as there:
        harness = a_harness({"http": {"url": there.url}}, state=tmp_path)
        assert harness.lost["events that would not survive a restart"] == 1
        harness.run(an_episode())
        there.received(2)
        harness.end()
    assert harness.lost.total() == 1
    (why,) = harness.reasons
    assert f"cannot use {tmp_path / 'notify'}" in why


def test_dead_letters_are_bounded(tmp_path: Path) -> None:
    letters = DeadLetters(tmp_path / "a.dead.jsonl", size=1000)
    for number in range(100):
        letters.write({"number": number, "text": "x" * 50})
    sizes = {file.name: file.stat().st_size for file in tmp_path.iterdir()}
    assert sizes.keys() == {"a.dead.jsonl", "a.dead.old.jsonl"}
    assert all(size <= 1000 for size in sizes.values())
    kept = [
        json.loads(line)["number"]
        for name in ("a.dead.old.jsonl", "a.dead.jsonl")
        for line in (tmp_path / name).read_text().splitlines()
    ]
    assert kept == list(range(kept[0], 100))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.dead.jsonl").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        DeadLetters(tmp_path / "a.dead.jsonl").write({"a": 1})
