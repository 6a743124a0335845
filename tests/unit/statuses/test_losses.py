"""Losses are logged at once, then at most once a minute, and in total at the end."""

from __future__ import annotations

from itertools import count

import pytest

from detector.engine.samples.intake import Intake
from detector.findings.losses import Losses
from tests.driving import POSITION, Drive, a_detector, a_rule, arrival

PAIRS = a_rule("near", scope={"pairs": {"position": POSITION, "within": 100}}, when="distance < 10")


def test_the_first_loss_is_reported_with_its_reason_and_further_ones_after_a_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    now = [0.0]
    drive = Drive(a_detector(), PAIRS)
    losses = Losses(drive.engine, Intake(lambda: 0), monotonic=lambda: now[0])
    losses.log_new()
    assert caplog.messages == []
    for second in (0, 20, 40, 60):
        now[0] = second
        drive.take(arrival(second / 20 + 0.5, "car", b"{", "pose"), until=second / 20 + 1)
        losses.log_new()
    logged = [message for message in caplog.messages if "could not be read" in message]
    assert len(logged) == 2
    assert logged[0].startswith("once a sample of stream pose could not be read; the last: vehicles/car/pose: not JSON")
    assert logged[1].startswith("3 times a sample of stream pose could not be read")
    caplog.clear()
    losses.sum_up()
    assert any(
        message.startswith("in total, 4 times a sample of stream pose could not be read") for message in caplog.messages
    )


@pytest.mark.parametrize(
    ("payload", "logged"),
    [
        (b'{"x": 1e13, "y": 0}', "x of car is 1e+13 m, which is not on the Earth"),
        (b'{"x": 0, "y": "far"}', "y of car is absent, NaN, not a number, or cannot be read"),
        (b'{"y": 0}', "x of car is absent, NaN, not a number, or cannot be read"),
    ],
)
def test_a_sample_without_a_position_is_reported_with_client_and_axis(
    caplog: pytest.LogCaptureFixture, payload: bytes, logged: str
) -> None:
    drive = Drive(a_detector(), PAIRS)
    drive.take(arrival(0.5, "car", payload, "pose"), until=1)
    Losses(drive.engine, Intake(lambda: 0)).log_new()
    assert f"once a sample had no position for EventRule near; the last: {logged}" in caplog.messages


def test_a_stamp_ahead_of_the_rest_is_reported_with_its_client(caplog: pytest.LogCaptureFixture) -> None:
    stream = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json", "stamp": "msg.t"}
    drive = Drive(a_detector(stream, clock="Data"))
    stamps = count(1_767_225_600)
    for client in ("a", "b", "a", "b"):
        drive.take(arrival(0.5, client, {"t": next(stamps)}, "pose"), until=1)
    drive.take(arrival(1.5, "c", {"t": next(stamps) + 3600}, "pose"), until=2)
    Losses(drive.engine, Intake(lambda: 0)).log_new()
    (message,) = [each for each in caplog.messages if "because their stamps are ahead" in each]
    assert "the last: c is 3601 s ahead of the rest" in message


def test_unknown_values_are_reported_by_their_reasons_with_samples_that_are_not_there_or_old(
    caplog: pytest.LogCaptureFixture,
) -> None:
    speeding = a_rule("fast", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 1")
    stream = {"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json", "staleAfter": "1s"}
    drive = Drive(a_detector(stream), speeding)
    drive.take(arrival(0.5, "car", {}, "speed"), until=4)
    Losses(drive.engine).sum_up()
    assert (
        "in total, 9 unknown values in 4 evaluations of EventRule fast: 4 times no sample or an old one; "
        '4 times no value for `v`; once no key "v" in the map'
    ) in caplog.messages
