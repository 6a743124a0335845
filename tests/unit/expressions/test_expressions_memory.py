"""Evaluating an expression a thousand times leaks nothing, for any function and any outcome."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from wayside.expressions import CelType, Environment

POLYGON = [[0.0, 0.0], [5.0, 0.0], [5.0, 5.0]]


@pytest.fixture
def frozen() -> Iterator[None]:
    """The collector looks through what is new only: all that the other tests have imported would take it seconds."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("frozen")
@pytest.mark.parametrize(
    ("source", "values"),
    [
        ("hypot(msg.x - 1.5, msg.x) < 150", {"x": 2.5}),
        ("hypot(msg.x, 3.5) + hypot(msg.x, 4.5)", {"x": 2.5}),
        ("yaw(msg.q)", {"q": {"x": 0.0, "y": 0.0, "z": 0.1, "w": 1.0}}),
        ("inside(msg.x, 2.5, msg.area)", {"x": 1.5, "area": POLYGON}),
        ("sqrt(msg.x)", {"x": -1.5}),  # it raises
        ("sqrt(msg.x) > 1.0 || msg.x < 0.0", {"x": -1.5}),  # and that is absorbed
        ("unmatched(msg.a, msg.b, 1.5)", {"a": POLYGON, "b": [[9.0, 9.0]]}),  # a list comes back
        ("utf8(msg.data)", {"data": b"some text that is long"}),
        ("[1.5, 2.5].map(v, hypot(v, msg.x))", {"x": 2.5}),
        ("'its-' + string(msg.x)", {"x": 4294967295.0}),
        ("string(msg.x)", {"x": "some text that is long"}),
        ("msg.x * 2.5", {"x": 2.5}),
    ],
)
def test_evaluations_leak_no_memory(source: str, values: dict[str, Any]) -> None:
    expression = Environment({"msg": CelType.DYN}).compile(source)

    def evaluate(times: int) -> None:
        for _ in range(times):
            expression.evaluate_or_unknown({"msg": values})

    def left_behind() -> int:
        gc.collect()
        before = sys.getallocatedblocks()
        evaluate(1000)
        gc.collect()
        return sys.getallocatedblocks() - before

    evaluate(100)
    # What leaks does so each time; another thread of the interpreter allocates now and then.
    assert min(left_behind() for _ in range(3)) < 100


def test_kept_arguments_and_results_stay_valid() -> None:
    expression = Environment({"msg": CelType.DYN}).compile("utf8(msg.data)")
    texts = [expression.evaluate({"msg": {"data": f"text number {number}".encode()}}) for number in range(1000)]
    gc.collect()
    assert texts == [f"text number {number}" for number in range(1000)]
    area = [list(corner) for corner in POLYGON]
    inside = Environment({"area": CelType.DYN}).compile("inside(1.5, 1.25, area)")
    for _ in range(1000):
        assert inside.evaluate({"area": area}) is True
    assert sys.getrefcount(area) < 10
    assert area == POLYGON
