"""The problems of a rule that do not depend on a Detector: its own expressions and names.

The rule is compiled against a Detector that has every stream, keeps everything and takes every action. So what remains
is the rule's alone, and no change of a Detector could put it right.
"""

from __future__ import annotations

from functools import lru_cache

from wayside.api import Detector, EventRule
from wayside.api.base import Metadata, PositiveDuration
from wayside.api.detector import BufferLimits, DetectorSpec
from wayside.api.stream import Stream
from wayside.rules.compiling import compile_rule
from wayside.rules.places import NO_MORE_IS_KNOWN
from wayside.rules.problems import RuleError, RuleProblem


def own_problems(rule: EventRule) -> tuple[RuleProblem, ...]:
    """Every problem that the rule has with each Detector; none where some Detector could evaluate it."""
    try:
        compile_rule(rule, _taking_everything(), places=NO_MORE_IS_KNOWN)
    except RuleError as error:
        # The stream's type and messages depend on the Detector; the ones here are invented.
        return tuple(each for each in error.problems if each.path[-1:] != ("stream",))
    return ()


class _AllStreams(DetectorSpec):
    """A Detector's spec with a stream of every name."""

    def stream(self, name: str) -> Stream | None:
        return self.streams[0].model_copy(update={"name": name, "items": "msg"})  # so that rules may read item


@lru_cache(maxsize=1)
def _taking_everything() -> Detector:
    raw = {
        "streams": [{"name": "any", "key": "${client:*}/any", "encoding": "json"}],
        "recordings": {"path": "/recordings"},
        "database": {"uriVariable": "WAYSIDE_DATABASE", "files": {"path": "/files"}},
    }
    spec = _AllStreams.model_validate(raw).model_copy(
        update={"buffer": BufferLimits(duration=PositiveDuration("999999h"))}
    )
    return Detector.model_construct(kind="Detector", metadata=Metadata(name="any"), spec=spec)
