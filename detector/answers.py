"""What a running detector answers to those who ask: its status."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import msgspec

from detector.evaluator import Evaluator
from detector.outlet import LiveOutlet
from detector.sources.supervision import SourceThread
from detector.status.model import Drops, Explanation, SourceStatus, Status, to_json

_PATIENCE = 5.0
"""Seconds in which the evaluation should have time for a question."""

_SILENT = 30.0
"""Seconds without a look after which the evaluation is taken for dead; one that is merely slow says so itself."""


class Answers:
    """Answers requests, on whichever thread they come."""

    def __init__(
        self, evaluator: Evaluator, outlet: Callable[[], LiveOutlet], sources: Callable[[], list[SourceThread]]
    ) -> None:
        """`outlet` gives the outlet: the network that it has changes with the Detector, as do the `sources`."""
        self._evaluator = evaluator
        self._sources = sources
        self._outlet = outlet
        self._answers: Mapping[str, Callable[[Mapping[str, str]], bytes]] = {"status": self._status}

    def answer(self, what: str, given: Mapping[str, str]) -> bytes:
        """The answer as JSON. Raises ValueError where there is none; the text says why."""
        answer = self._answers.get(what)
        if answer is None:
            raise ValueError(f"a detector does not answer {what!r}: ask for one of {', '.join(self._answers)}")
        return answer(given)

    def status(self) -> Status:
        """The newest status, with what only the shell knows."""
        latest, outlet = self._evaluator.status.latest, self._outlet()
        dropped = [
            Drops("event_unpublished", "events not published", outlet.network.dropped_events),
            Drops("event_unwritten", "events missing in events.jsonl", outlet.unwritten),
        ]
        sources = [
            SourceStatus(each.source.name, each.source.plugin, each.state.value, each.messages, each.last_error)
            for each in self._sources()
        ]
        return msgspec.structs.replace(
            latest, connected=outlet.network.connected, drops=[*latest.drops, *dropped], sources=sources
        )

    def healthy(self) -> tuple[bool, bytes]:
        """Whether the evaluation goes on, for /healthz."""
        silent = self._evaluator.status.silence
        return silent < _SILENT, f"the evaluation looked {silent:.1f} s ago\n".encode()

    def ready(self) -> tuple[bool, bytes]:
        """Whether samples can come in and be evaluated, for /readyz."""
        well, text = self.healthy()
        joined = self._outlet().network.joined
        return well and joined, text + (b"" if joined else b"no Zenoh session yet\n")

    def _status(self, given: Mapping[str, str]) -> bytes:
        status = self.status()
        rule = given.get("rule")
        if rule is None:
            return to_json(status)
        rules = [each for each in status.rules if each.name == rule]
        if not rules:
            raise ValueError(f"detector {status.holder} has no rule {rule}; it has {_listed(status)}")
        explanation = self._explanation(rule, given.get("subject"), given.get("wait", "1"))
        return to_json(msgspec.structs.replace(status, rules=rules, explanation=explanation))

    def _explanation(self, rule: str, subject: str | None, wait: str) -> Explanation | None:
        """What the rule's next evaluation sees; None where there is none within so many seconds."""
        if not re.fullmatch(r"[0-9]{1,2}(\.[0-9]{1,3})?", wait):
            raise ValueError(f"wait={wait}: give seconds below 100, e.g. wait=2.5")
        watching = None
        try:
            watching = self._evaluator.call(lambda: self._evaluator.status.watch(rule, subject)).result(_PATIENCE)
            return watching.result(float(wait))
        except ValueError as error:
            return Explanation(0.0, [], [str(error)])
        except TimeoutError:
            return None
        finally:
            if watching is not None:
                watching.cancel()


def _listed(status: Status) -> str:
    return ", ".join(rule.name for rule in status.rules) or "none"
