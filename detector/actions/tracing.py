"""The spans of episodes and of their tasks, if traces are on (see `wayside.process.tracing`).

The span of an episode is exported when the episode ends. Its ids are derived from the episode's id, so its event and
its tasks carry them from the start, and a detector that restores the episode ends the same span.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec

from detector.engine.consequences import Consequence, EpisodeEnded, RunStarted
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord
from wayside.api import ApplicationTask
from wayside.api.applicationtask import TRACEPARENT_ANNOTATION
from wayside.process.tracecontext import Attribute, Span, TraceContext, episode_context
from wayside.process.tracing import tracing

if TYPE_CHECKING:
    from wayside.process.spans import Tracing


class EpisodeTraces:
    """Adds the trace context to episodes and tasks, and exports their spans. Thread-safe; never waits."""

    def __init__(self, tracing: Tracing) -> None:
        self.tracing = tracing

    def event(self, event: Event) -> Event:
        """The event with the trace context of its episode."""
        return msgspec.structs.replace(event, traceparent=str(self._context(event.episode)))

    def consequences(self, consequences: Sequence[Consequence]) -> list[Consequence]:
        """The same for the consequences of actions."""
        return [
            replace(each, event=self.event(each.event)) if isinstance(each, RunStarted | EpisodeEnded) else each
            for each in consequences
        ]

    def over(self, event: Event) -> None:
        """An episode ended: export its span."""
        if event.end_time is None or event.reason is None:
            return
        episode = event.episode
        self.tracing.emit(
            Span(
                _name(episode),
                start=episode.start_time,
                end=event.end_time,
                context=self._context(episode),
                attributes={
                    **_about(event.holder, episode),
                    "wayside.reason": event.reason.value,
                },
            )
        )

    def task(self, demand: Demand, task: ApplicationTask) -> ApplicationTask:
        """The demand's task with its trace context."""
        annotations = {**task.metadata.annotations, TRACEPARENT_ANNOTATION: str(self._of_demand(demand))}
        return task.model_copy(update={"metadata": task.metadata.model_copy(update={"annotations": annotations})})

    def created(self, demand: Demand, began: int) -> None:
        """Export the span of a task that was created; `began`: start of the request, nanoseconds since the epoch."""
        self.tracing.emit(
            Span(
                f"create task {demand.action}",
                start=began,
                end=time.time_ns(),
                parent=self._context(demand.episode),
                context=self._of_demand(demand),
                attributes={
                    **_about(demand.holder, demand.episode),
                    "wayside.action": demand.action,
                    "wayside.task": demand.name,
                    "wayside.template": demand.template,
                    "wayside.operation": demand.operation.value,
                    "wayside.priority": demand.priority,
                },
            )
        )

    def _of_demand(self, demand: Demand) -> TraceContext:
        return self._context(demand.episode).child(demand.name)

    def _context(self, episode: EpisodeRecord) -> TraceContext:
        context = episode_context(episode.id)
        return replace(context, sampled=self.tracing.sampled(context, _name(episode)))


@contextmanager
def episode_traces(*, export: bool = True) -> Iterator[EpisodeTraces | None]:
    """Traces if the environment requests them, else None. At exit, queued spans are sent, for two seconds at most.

    A replay does not `export`: its spans were exported during the drive.
    """
    exporter = tracing("wayside-detector", export=export)
    if exporter is None:
        yield None
        return
    try:
        yield EpisodeTraces(exporter)
    finally:
        exporter.close()


def _name(episode: EpisodeRecord) -> str:
    return f"episode {episode.rule}"


def _about(holder: str, episode: EpisodeRecord) -> dict[str, Attribute]:
    return {
        "wayside.holder": holder,
        "wayside.rule": episode.rule,
        "wayside.subject": episode.subject,
        "wayside.subjects": list(episode.clients),
        "wayside.episode": episode.id,
    }
