"""The state of an open episode of a rule: its record, and the demands of its deploy actions. The budget of starts."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from detector.engine.counters import RuleCounters
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.episodes import EndReason
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord, OpenEpisode, episode_id
from detector.engine.episodes.rendering import Rendered, followed, render_templates
from detector.engine.episodes.statistics import Statistics
from detector.engine.episodes.subjects import FLEET, Subject
from wayside.expressions import InterpolationError
from wayside.rules import CompiledDeploy, CompiledRule


@dataclass(frozen=True, slots=True)
class DetectorIdentity:
    """The detector that the episodes belong to."""

    detector: str
    holder: str
    namespace: str


def new_record(
    rule: CompiledRule, identity: DetectorIdentity, subject: Subject, onset: int, now: int, values: Mapping[str, Any]
) -> EpisodeRecord:
    """The record of an episode that starts `now`; times are nanoseconds since the epoch."""
    text = subject.text
    return EpisodeRecord(
        id=episode_id(identity.holder, rule.name, text, now),
        rule=rule.name,
        subject=text,
        clients=subject.clients,
        element=subject.element,
        onset_time=onset,
        start_time=now,
        values=values,
        classification=rule.classification,
        rule_digest=rule.digest,
    )


class EpisodeState(msgspec.Struct, eq=False):
    """The state of an open episode."""

    record: EpisodeRecord
    variables: Mapping[str, Any] | None
    """The variables of the conditions at the start; None until the next evaluation if the episode was restored, or
    started while the rule had no actions."""
    demands: dict[str, Demand] = {}
    """By action; an action without an entry cannot be rendered yet."""
    outdated: set[str] = set()
    """Actions that changed since the start: their demands stay valid until they can be rendered again."""
    statistics: Statistics | None = None
    """None if the rule has no signals over the episode."""

    def started(self, rule: CompiledRule, identity: DetectorIdentity) -> Event:
        """The start event, with the texts rendered for the rule's current actions."""
        rendered = (
            {action.name: render_templates(action, self.variables) for action in rule.actions} if rule.actions else {}
        )
        return self._event(rule, identity, self.record.values, rendered)

    def ended(
        self,
        rule: CompiledRule,
        identity: DetectorIdentity,
        now: int,
        reason: EndReason,
        values: Mapping[str, Any],
        variables: Mapping[str, Any],
    ) -> Event:
        """The end event; `values` and `variables` are those of the last evaluation.

        Templates that read statistics of the episode are rendered again.
        """
        rendered: dict[str, Rendered] = {}
        if rule.actions and (names := {signal.name for signal in rule.derived if signal.episode}):
            seen = {**(self.variables or {}), **variables}
            for action in rule.actions:
                if any(names & template.names for template in action.templates.values()):
                    rendered[action.name] = render_templates(action, seen)
        return self._event(rule, identity, values, rendered, now, reason)

    def to_open_episode(self) -> OpenEpisode:
        """Convert the episode to the form that survives a restart."""
        return OpenEpisode(self.record, None if self.statistics is None else self.statistics.to_document())

    def is_complete(self, rule: CompiledRule) -> bool:
        """Whether all demands are up to date with the rule."""
        return not self.outdated and len(self.demands) >= len(rule.deploys)

    def change(self, rule: CompiledRule, changed: Collection[str], gone: Collection[str]) -> None:
        """The rule's deploy actions changed: demands of removed actions end at once, the others stay valid for now.

        The end event has the rule's current classification.
        """
        self.record = msgspec.structs.replace(self.record, classification=rule.classification)
        for action in gone:
            self.demands.pop(action, None)
        self.outdated = (self.outdated | set(changed)) - set(gone)

    def render(self, rule: CompiledRule, identity: DetectorIdentity, counters: RuleCounters) -> int:
        """Render demands that are missing or outdated; failed ones are retried at the next tick.

        Returns the number of demands that changed.
        """
        changes = 0
        for deploy in rule.deploys if self.variables is not None else ():
            if deploy.action not in self.demands or deploy.action in self.outdated:
                try:
                    parameters = deploy.parameters.render(self.variables or {})
                except InterpolationError as error:
                    counters.errors += 1
                    counters.last_error = f"action {deploy.action} of {self.record.subject}: {error}"
                    continue
                self.demands[deploy.action] = self._demand(identity, deploy, parameters)
                self.outdated.discard(deploy.action)
                changes += 1
        return changes

    def follow(self, rule: CompiledRule, variables: Mapping[str, Any], counters: RuleCounters) -> int:
        """Evaluate the parameters of actions with `follow` again. Returns the number of demands that changed."""
        changes = 0
        for deploy in rule.deploys:
            demand = self.demands.get(deploy.action)
            if deploy.follow and demand is not None and deploy.action not in self.outdated:
                parameters = followed(deploy, self.record.subject, demand.parameters, variables, counters)
                if parameters != demand.parameters:
                    self.demands[deploy.action] = replace(demand, parameters=parameters)
                    changes += 1
        return changes

    def _demand(self, identity: DetectorIdentity, deploy: CompiledDeploy, parameters: Any) -> Demand:
        return Demand(
            self.record,
            action=deploy.action,
            template=deploy.template,
            operation=deploy.operation,
            priority=deploy.priority,
            parameters=parameters or {},
            detector=identity.detector,
            holder=identity.holder,
            namespace=identity.namespace,
        )

    def _event(
        self,
        rule: CompiledRule,
        identity: DetectorIdentity,
        values: Mapping[str, Any],
        rendered: Mapping[str, Rendered],
        end: int | None = None,
        reason: EndReason | None = None,
    ) -> Event:
        return Event(
            holder=identity.holder,
            episode=self.record,
            values=values,
            end_time=end,
            reason=reason,
            models={model.name: model.runner.sha256 for model in rule.models if model.runner is not None},
            dry_run=rule.dry_run,
            rendered=rendered,
        )


HOUR = 3_600 * 10**9
"""Nanoseconds."""


class Budget:
    """Counts the starts of the last hour by client. An episode of a pair counts for both clients."""

    def __init__(self) -> None:
        self._starts: dict[str, deque[int]] = {}

    def try_acquire(self, clients: Sequence[str], now: int, limit: int) -> bool:
        """Count this start, if each of the clients had fewer than `limit` starts in (now - 1 h, now]; else False."""
        names = clients or (FLEET,)
        for name in names:
            starts = self._starts.get(name)
            while starts and starts[0] <= now - HOUR:
                starts.popleft()
            if starts and len(starts) >= limit:
                return False
        for name in names:
            self._starts.setdefault(name, deque()).append(now)
        return True

    def expire(self, now: int) -> None:
        """Forget clients without starts in the last hour."""
        for name in [name for name, starts in self._starts.items() if not starts or starts[-1] <= now - HOUR]:
            del self._starts[name]
