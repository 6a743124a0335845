"""The journal and the dead letters: what a kill leaves, what is torn, what is shared, and how big they get."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from detector.actions.notify.dead_letters import DeadLetters
from detector.actions.notify.journal import Journal, JournalError
from tests.http_servers import answers, endpoint, hangs
from tests.notifying import a_desk

_KILLED = """
import sys
from pathlib import Path
from tests.notifying import a_desk, an_episode
desk = a_desk({"http": {"url": sys.argv[1], "timeout": "2m"}, "text": "x"}, state=Path(sys.argv[2]))
for number in range(20):
    desk.run(an_episode(f"e{number}", rendered={"text": f"number {number}"}))
print("accepted", flush=True)
sys.stdin.read()
"""


def test_what_was_reported_before_a_kill_is_delivered_after_it_each_event_once(tmp_path: Path) -> None:
    with endpoint(hangs()) as there:  # so that nothing else is on its way when the process ends
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
        desk = a_desk({"http": {"url": there.url}, "text": "x"}, state=tmp_path)
        events = [json.loads(request.body) for request in there.received(40)]
        desk.end()
    assert not desk.lost
    assert [event["id"] for event in events] == [
        f"e{number}.{what}" for number in range(20) for what in ("started", "ended")
    ]
    assert events[38]["data"]["notification"] == {"text": "number 19"}
    assert not list((tmp_path / "notify").iterdir())


def test_what_was_put_and_not_dropped_is_there_again(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "j")
    for name in "abc":
        journal.put(name, {"name": name})
    journal.put("a", {"name": "A"})
    journal.drop(["b", "unknown"])
    journal.close()
    again = Journal(tmp_path, "j")
    assert again.live == {"a": {"name": "A"}, "c": {"name": "c"}}
    again.drop(["a", "c"])
    again.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("torn", [b'{"put": "x", "docu', b'{"put": "x"', b"\xff"])
def test_a_line_that_was_cut_takes_nothing_else_with_it(tmp_path: Path, torn: bytes) -> None:
    journal = Journal(tmp_path, "j")
    journal.put("a", {})
    journal.close()
    (file,) = tmp_path.iterdir()
    with file.open("ab") as out:
        out.write(torn)
    again = Journal(tmp_path, "j")
    assert (again.live, again.unreadable) == ({"a": {}}, 0)
    again.put("b", {})
    again.close()
    assert Journal(tmp_path, "j").live == {"a": {}, "b": {}}


def test_lines_that_are_no_entries_are_counted(tmp_path: Path) -> None:
    (tmp_path / "j.0.jsonl").write_text('[1]\n{"put": "a", "document": 3}\n{"put": "b", "document": {}}\nnonsense\n')
    journal = Journal(tmp_path, "j")
    assert (journal.live, journal.unreadable) == ({"b": {}}, 3)


def test_two_at_the_same_time_have_files_of_their_own_and_the_next_takes_both_over(tmp_path: Path) -> None:
    first, second = Journal(tmp_path, "j"), Journal(tmp_path, "j")
    first.put("a", {})
    second.put("b", {})
    assert (first.live, second.live) == ({"a": {}}, {"b": {}})
    first.close()
    second.close()
    third = Journal(tmp_path, "j")
    assert third.live == {"a": {}, "b": {}}
    assert len(list(tmp_path.iterdir())) == 1


def test_the_file_does_not_grow_with_what_is_dropped(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "j")
    journal.put("kept", {"text": "x"})
    for number in range(300):
        journal.put(str(number), {"text": "x" * 20_000})
        journal.drop([str(number)])
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 3_000_000
    journal.close()
    assert Journal(tmp_path, "j").live == {"kept": {"text": "x"}}


def test_a_folder_that_cannot_be_written_is_reported_and_costs_only_the_keeping(tmp_path: Path) -> None:
    (tmp_path / "notify").write_text("a file where a folder should be")
    with pytest.raises(JournalError, match="cannot write"):
        Journal(tmp_path / "notify", "j")
    with endpoint() as there:
        desk = a_desk({"http": {"url": there.url}}, state=tmp_path)
        assert desk.lost["events that would not survive a restart"] == 1
        desk.end()


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
