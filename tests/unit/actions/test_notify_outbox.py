"""The outbox loses and duplicates nothing, keeps the order of each episode, is bounded, and backs off."""

from __future__ import annotations

from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from detector.actions.notify.events import Groups
from detector.actions.notify.notice import GROUP_TYPE, Notice, NoticeTexts, event_of_group
from detector.actions.notify.outbox import (
    LONGEST,
    LONGEST_RETRY_AFTER,
    AttemptResult,
    Delivery,
    Outbox,
    OutboxMessage,
    RateLimit,
)
from tests.notifying import an_episode

DELIVERED, AGAIN, REFUSED = (
    Delivery(AttemptResult.DELIVERED),
    Delivery(AttemptResult.AGAIN),
    Delivery(AttemptResult.REFUSED),
)
AWAY = Delivery(AttemptResult.AGAIN, whole=True)


def notice(episode: str, what: str = "started", **labels: str) -> Notice:
    made = an_episode(episode)
    event: Any = made.started if what == "started" else made.ended
    return Notice(episode, event, NoticeTexts(labels=labels), created=0.0)


def message(episode: str, what: str = "started") -> OutboxMessage:
    one = notice(episode, what)
    return OutboxMessage(one.event, [one])


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.booleans()), max_size=20),
    st.lists(st.sampled_from([DELIVERED, AGAIN, REFUSED, AWAY]), max_size=60),
)
def test_each_message_is_settled_once_and_each_episode_in_order(
    reported: list[tuple[str, bool]], answers: list[Delivery]
) -> None:
    box, now = Outbox(100, 3600.0), 0.0
    waiting = [message(episode, "started" if start else "ended") for episode, start in reported]
    assert all(map(box.add, waiting))
    settled: list[OutboxMessage] = []
    for answer in [*answers, *([DELIVERED] * len(waiting))]:
        wait = box.wait(now)
        if wait is None:
            break
        now += wait
        taken = box.take(now)
        assert taken is not None, "what wait promises is there"
        if box.record_result(taken, answer, now, wall=0.0) is not AttemptResult.AGAIN:
            settled.append(taken)
    assert sorted(map(id, settled)) == sorted(map(id, waiting))
    for episode in "abc":
        mine = [each for each in settled if episode in each.episodes]
        assert mine == [each for each in waiting if episode in each.episodes]


def test_a_full_outbox_rejects_messages() -> None:
    box = Outbox(2, 3600.0)
    assert [box.add(message(name)) for name in "abc"] == [True, True, False]
    assert len(box) == 2


def test_an_absent_endpoint_is_retried_with_growing_backoff_for_all_messages() -> None:
    box, now = Outbox(10, 1e9), 0.0
    for name in "ab":
        box.add(message(name))
    waits: list[float] = []
    for _ in range(14):
        taken = box.take(now)
        assert taken is not None
        box.record_result(taken, AWAY, now, wall=0.0)
        assert box.take(now) is None
        waits.append(box.wait(now) or 0.0)
        now += waits[-1]
    assert 0.5 <= waits[0] <= 1.0
    assert LONGEST / 2 <= waits[-1] <= LONGEST
    assert len(set(waits)) > 10, "there is jitter in it"


def test_a_rejected_message_delays_no_other() -> None:
    box = Outbox(10, 3600.0)
    for name in "ab":
        box.add(message(name))
    first = box.take(0.0)
    assert first is not None
    box.record_result(first, AGAIN, 0.0, wall=0.0)
    second = box.take(0.0)
    assert second is not None
    assert second is not first


@pytest.mark.parametrize(("retry_after", "waited"), [(100.0, 100.0), (1e9, LONGEST_RETRY_AFTER)])
def test_retry_after_is_honoured_up_to_a_bound(retry_after: float, waited: float) -> None:
    box = Outbox(10, 1e9)
    box.add(message("a"))
    taken = box.take(0.0)
    assert taken is not None
    box.record_result(taken, Delivery(AttemptResult.AGAIN, retry_after=retry_after, whole=True), 0.0, wall=0.0)
    assert box.wait(0.0) == waited


def test_an_expired_message_is_given_up_after_an_attempt() -> None:
    box = Outbox(10, 60.0)
    box.add(message("a"))
    taken = box.take(0.0)
    assert taken is not None
    assert box.record_result(taken, AWAY, 0.0, wall=59.0) is AttemptResult.AGAIN
    again = box.take(10.0)
    assert again is taken
    assert box.record_result(taken, AWAY, 10.0, wall=60.0) is AttemptResult.REFUSED
    assert len(box) == 0


@given(st.integers(1, 5), st.lists(st.integers(0, 6), max_size=30))
def test_the_rate_budget_holds_in_every_interval_of_its_length(messages: int, pauses: list[int]) -> None:
    budget, now, sent = RateLimit(messages, 10.0), 0.0, []
    for pause in pauses:
        now += pause
        now += budget.wait(now)
        assert budget.wait(now) == 0
        budget.spend(now)
        sent.append(now)
    assert all(sum(begin <= each < begin + 10 for each in sent) <= messages for begin in sent)


@given(st.lists(st.tuples(st.sampled_from(["", "A1", "B7"]), st.integers(0, 3)), max_size=30), st.integers(1, 10))
def test_every_event_is_in_one_group_of_its_kind_and_waits_within_the_bound(
    reported: list[tuple[str, int]], most: int
) -> None:
    groups, now = Groups(["road"], 5.0, most), 0.0
    begun: dict[str, float] = {}
    seen: list[str] = []

    def close(everything: bool = False) -> None:
        for closed in groups.closed(now, everything):
            assert len({each.texts.labels["road"] for each in closed}) == 1
            assert now - begun[closed[0].episode] <= 5.0
            seen.extend(each.episode for each in closed)

    for number, (road, pause) in enumerate(reported):
        arrival = now + pause
        while (due := groups.next_due()) is not None and due <= arrival:
            now = due
            close()
        now = arrival
        begun[str(number)] = now
        groups.add(notice(str(number), road=road), now)
        close()
        assert len(begun) - len(seen) <= most
    close(everything=True)
    assert sorted(seen) == sorted(begun)
    assert groups.next_due() is None


def test_a_group_is_a_cloudevent_with_an_id_derived_from_its_events() -> None:
    some = [notice("a"), notice("a", "ended"), notice("b")]
    event = event_of_group(some, "notify", [], 2)
    assert event["id"] == event_of_group(some, "notify", [], 3)["id"] != event_of_group(some[:2], "notify", [], 2)["id"]
    assert (event["type"], event["subject"]) == (GROUP_TYPE, "braking/notify")
    counts = {name: event["data"][name] for name in ("count", "started", "ended", "omitted")}
    assert counts == {"count": 3, "started": 2, "ended": 1, "omitted": 1}
