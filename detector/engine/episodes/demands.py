"""Demands: the applications that deploy actions of open episodes request, and their form as ApplicationTasks.

A demand exists while its episode is open. Its name is derived from its contents, so that a restarted detector finds
its own tasks again and never creates a second task for one demand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from detector.engine.episodes.plain import plain
from detector.engine.episodes.record import EpisodeRecord, identifier
from wayside.api.applicationtask import (
    HOLDER_LABEL,
    RULE_DIGEST_ANNOTATION,
    ApplicationTask,
    ApplicationTaskSpec,
    Requester,
    TaskEvent,
)
from wayside.api.base import JsonValue, Metadata
from wayside.api.classification import Classification
from wayside.api.freedata import fitting
from wayside.api.operation import Operation
from wayside.names import parse_subject
from wayside.times import format_time, parse_time

_LABEL_LIMIT = 63


@dataclass(frozen=True)
class Demand:
    """The application that one deploy action of one open episode requests."""

    episode: EpisodeRecord
    action: str
    template: str
    priority: int
    parameters: Mapping[str, JsonValue]
    """Evaluated parameters; only these may change while the episode is open."""
    detector: str
    holder: str
    namespace: str
    operation: Operation = Operation.DEPLOY

    @property
    def fixed(self) -> tuple[str, Operation, int]:
        """The fields that cannot change while the demand exists: template, operation and priority."""
        return self.template, self.operation, self.priority

    @cached_property
    def name(self) -> str:
        """The name of the task: the same demand always has the same one. At most 63 characters."""
        episode = self.episode
        parts = (self.holder, episode.rule, self.action, episode.subject, str(episode.start_time))
        return f"{episode.rule[:46]}-{_digest(*parts)}"


class DemandChange(NamedTuple):
    """A demand began or changed (end None), or ended; nanoseconds since the epoch."""

    time: int
    demand: Demand
    end: int | None


def holder_label(holder: str) -> str:
    """The value of the label `wayside.dev/holder`: the holder, shortened with a digest if it is too long."""
    if len(holder) <= _LABEL_LIMIT:
        return holder
    return f"{holder[:46]}-{_digest(holder)}"


def to_task(demand: Demand, end_time: int | None = None) -> ApplicationTask:
    """The demand as an object for the API server or a file.

    A resource does not distinguish absent from null, so null parameters and values are left out, and so are NaN and
    infinities, which JSON does not have. Of the event's values, those that exceed the bounds of free data are left out.

    Args:
        demand: the demand.
        end_time: when the episode ended, in nanoseconds since the epoch; None while it is open.

    Raises:
        ValueError: a part does not fit into an ApplicationTask, e.g. a subject that is too long.
    """
    episode = demand.episode
    return ApplicationTask(
        metadata=Metadata(
            name=demand.name,
            namespace=demand.namespace,
            labels={HOLDER_LABEL: holder_label(demand.holder)},
            annotations={RULE_DIGEST_ANNOTATION: episode.rule_digest} if episode.rule_digest else {},
        ),
        spec=ApplicationTaskSpec(
            template_name=demand.template,
            operation=demand.operation,
            priority=demand.priority,
            parameters=plain(demand.parameters),
            requester=Requester(detector_name=demand.detector, holder=demand.holder, subjects=list(episode.clients)),
            event=TaskEvent(
                id=episode.id,
                rule=episode.rule,
                action=demand.action,
                subject=episode.subject,
                onset_time=format_time(episode.onset_time),
                start_time=format_time(episode.start_time),
                classification=None
                if episode.classification is None
                else Classification.model_validate(episode.classification),
                values=fitting(plain(episode.values)),
            ),
            end_time=None if end_time is None else format_time(end_time),
        ),
    )


def from_task(task: ApplicationTask) -> Demand | None:
    """The demand of a task; None if no detector emitted the task (no holder or no event)."""
    spec = task.spec
    if spec.event is None or spec.requester.holder is None or spec.requester.detector_name is None:
        return None
    event = spec.event
    try:
        _, element = parse_subject(event.subject)
    except ValueError:
        element = None
    episode = EpisodeRecord(
        id=event.id,
        rule=event.rule,
        subject=event.subject,
        clients=tuple(spec.requester.subjects),
        element=element,
        onset_time=parse_time(event.onset_time),
        start_time=parse_time(event.start_time),
        values=event.values,
        classification=None if event.classification is None else event.classification.to_json(),
        rule_digest=task.metadata.annotations.get(RULE_DIGEST_ANNOTATION, ""),
    )
    return Demand(
        episode,
        action=event.action,
        template=spec.template_name,
        priority=spec.priority,
        parameters=spec.parameters,
        detector=spec.requester.detector_name,
        holder=spec.requester.holder,
        namespace=task.metadata.namespace,
        operation=spec.operation,
    )


def _digest(*parts: str) -> str:
    """A digest of the parts, length-prefixed so that different lists never collide."""
    return identifier(b"".join(len(data).to_bytes(8, "big") + data for data in map(str.encode, parts)))
