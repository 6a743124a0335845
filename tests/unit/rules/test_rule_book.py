"""A rule that is refused goes on as it last was."""

from __future__ import annotations

from detector.assembly import RuleBook
from tests.driving import a_detector, a_rule

GOOD = {"signals": [{"name": "fast", "stream": "speed", "value": "msg.v"}], "when": "fast > 10"}


def test_a_refused_version_leaves_the_last_good_one_in_place_and_says_so() -> None:
    book, detector = RuleBook(), a_detector()
    (first,), refused = book.compile([a_rule("r", **GOOD)], detector, {})
    assert refused == []
    (kept, other), (refusal,) = book.compile(
        [a_rule("r", **GOOD | {"when": "fst > 10"}), a_rule("s", **GOOD)], detector, {}
    )
    assert (kept.name, kept.digest, other.name) == ("r", first.digest, "s")
    assert "EventRule r is refused; keeping its last good version: spec.when" in str(refusal)
    assert "did you mean `fast`?" in str(refusal)
    (mended, _), refused = book.compile(
        [a_rule("r", **GOOD | {"when": "fast > 20"}), a_rule("s", **GOOD)], detector, {}
    )
    assert mended.digest != first.digest
    assert refused == []


def test_a_rule_that_was_never_good_is_not_evaluated() -> None:
    compiled, (refusal,) = RuleBook().compile([a_rule("r", **GOOD | {"when": "fst > 10"})], a_detector(), {})
    assert compiled == []
    assert str(refusal).startswith("EventRule r is refused: spec.when")


def test_a_rule_that_is_gone_is_not_remembered() -> None:
    book, detector = RuleBook(), a_detector()
    book.compile([a_rule("r", **GOOD)], detector, {})
    book.compile([], detector, {})
    compiled, _ = book.compile([a_rule("r", **GOOD | {"when": "fst > 10"})], detector, {})
    assert compiled == []
