"""A rejected rule keeps its last good version."""

from __future__ import annotations

from detector.assembly import RuleIndex
from tests.driving import a_detector, a_rule

GOOD = {"signals": [{"name": "fast", "stream": "speed", "value": "msg.v"}], "when": "fast > 10"}


def test_a_rejected_version_keeps_the_last_good_one_and_is_reported() -> None:
    index, detector = RuleIndex(), a_detector()
    (first,), refused = index.compile([a_rule("r", **GOOD)], detector, {})
    assert refused == []
    (kept, other), (refusal,) = index.compile(
        [a_rule("r", **GOOD | {"when": "fst > 10"}), a_rule("s", **GOOD)], detector, {}
    )
    assert (kept.name, kept.digest, other.name) == ("r", first.digest, "s")
    assert "EventRule r is refused; keeping its last good version: spec.when" in str(refusal)
    assert "did you mean `fast`?" in str(refusal)
    (mended, _), refused = index.compile(
        [a_rule("r", **GOOD | {"when": "fast > 20"}), a_rule("s", **GOOD)], detector, {}
    )
    assert mended.digest != first.digest
    assert refused == []


def test_a_rule_without_a_good_version_is_not_evaluated() -> None:
    compiled, (refusal,) = RuleIndex().compile([a_rule("r", **GOOD | {"when": "fst > 10"})], a_detector(), {})
    assert compiled == []
    assert str(refusal).startswith("EventRule r is refused: spec.when")


def test_a_removed_rule_is_forgotten() -> None:
    index, detector = RuleIndex(), a_detector()
    index.compile([a_rule("r", **GOOD)], detector, {})
    index.compile([], detector, {})
    compiled, _ = index.compile([a_rule("r", **GOOD | {"when": "fst > 10"})], detector, {})
    assert compiled == []
