"""Authors of rules and templates cannot get the detector's own Secrets, unlimited memory or unlimited time."""

from __future__ import annotations

import time
from typing import Any

import pytest

from detector.actions.registry import secret_problems
from detector.assembly import RuleIndex, stream_readers
from tests.driving import Drive, a_detector, a_rule, arrival
from wayside.expressions import CelType, Environment, ExpressionError
from wayside.rules import RuleError

TEN = "[1,2,3,4,5,6,7,8,9,10]"


def balanced(name: str, levels: int) -> str:
    """`name` added to itself, 2 to the power of `levels` times, without deep nesting."""
    half = name if not levels else balanced(name, levels - 1)
    return half if not levels else f"({half}+{half})"


def multiplied(start: str, times: int, levels: int) -> str:
    for each in range(times):
        start = f"[{start}].map(x{each}, {balanced(f'x{each}', levels)})[0]"
    return start


@pytest.mark.parametrize("start", ["'" + "a" * 500 + "'", "v", "[1]", "client"])
def test_an_expression_that_grows_a_value_exponentially_is_rejected(start: str) -> None:
    environment = Environment({"v": CelType.DYN, "client": CelType.STRING})
    with pytest.raises(ExpressionError, match="more than 1000 copies") as caught:
        environment.compile(f"size({multiplied(start, 4, 5)}) > 1")
    assert "join fewer" in str(caught.value)
    environment.compile(f"size({multiplied(start, 3, 3)}) > 1")


@pytest.mark.parametrize(
    "harmless",
    [
        "v.points.map(p, p.x * p.x + p.y * p.y).exists(d, d < 25)",
        "v.a.all(x, v.b.all(y, v.c.exists(z, x + y > z)))",
        "v.points.filter(p, p.x > 0).map(p, {'x': p.x + 1, 'y': p.y + 1})[0].x > 1",
        "'a' + string(v.a) + 'b' + string(v.b) == client",
    ],
)
def test_usual_expressions_are_not_rejected_as_growing(harmless: str) -> None:
    Environment({"v": CelType.DYN, "client": CelType.STRING}).compile(harmless)


def test_an_endless_loop_is_an_error_of_its_rule_only() -> None:
    endless = "true"
    for each in range(8):
        endless = f"{TEN}.all(x{each}, {endless})"
    speed = {"name": "v", "stream": "speed", "value": "msg.v"}
    drive = Drive(
        a_detector(),
        a_rule("endless", signals=[speed], when=f"v > 10 && {endless}"),
        a_rule("fast", signals=[speed], when="v > 10"),
    )
    begin = time.monotonic()
    assert drive.take(arrival(0.5, "car", {"v": 20}), until=1) == ["fast car started 1"]
    assert drive.engine.rules["endless"].counters.last_error == (
        "when of car (v of stream speed): Iteration budget exceeded"
    )
    assert time.monotonic() - begin < 60, "it would take years"


def test_an_expression_that_is_too_large_to_read_is_refused() -> None:
    with pytest.raises(RuleError, match="nested too deeply"):
        Drive(a_detector(), a_rule("deep", when="(" * 300 + "true" + ")" * 300))


OWN = {"zenoh": {"mode": "client", "connect": ["tls/zenoh:7447"], "tlsSecretName": "own"}}


KEY = {"name": "own", "key": "tls.key"}
URL = "https://e.org/"


@pytest.mark.parametrize(
    ("http", "place"),
    [
        ({"url": URL, "headers": [{"name": "X", "secretKeyRef": KEY}]}, "headers[0].secretKeyRef.name"),
        ({"urlSecretKeyRef": KEY}, "urlSecretKeyRef.name"),
        ({"url": URL, "credentialsSecretName": "own"}, "credentialsSecretName"),
        ({"url": URL, "tlsSecretName": "own"}, "tlsSecretName"),
    ],
)
def test_a_rule_cannot_send_the_detectors_own_secret(http: dict[str, Any], place: str) -> None:
    rule = a_rule(when="true", actions=[{"name": "send", "notify": {"http": http}}])
    (problem,) = secret_problems(rule, a_detector(**OWN))
    assert str(problem).startswith(
        f"spec.actions[0].notify.http.{place}: the Secret own contains the network credentials of the Detector"
    )
    assert [*secret_problems(rule, a_detector(**OWN, mode="Standalone", pod={"secretNames": ["own"]}))] == []
    assert [*secret_problems(rule, a_detector())] == []
    detector = a_detector(**OWN)
    evaluated, (refusal,) = RuleIndex().compile([rule], detector, stream_readers(detector).fields)
    assert evaluated == []
    assert "the Secret own contains the network credentials of the Detector" in str(refusal)
