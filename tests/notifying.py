"""Runs notify actions without a host: settings, reports, losses, and episodes for them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from detector.actions import ActionContext, Completion, DetectorConfiguration, Episode, Outcome, OutcomeState
from detector.actions.notify import Notify
from detector.streams.codecs.ros import standard
from tests.driving import SECOND, START, a_detector, a_rule
from tests.patience import PATIENCE
from wayside.api.actions.notify import NotifyAction as Parameters
from wayside.times import format_time


class NoMessenger:
    """No Zenoh session."""

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        raise AssertionError("nothing is published here")

    def query(self, selector: str, payload: bytes | None, timeout: float) -> list[bytes]:
        raise AssertionError("there are no queries here")


@dataclass
class Harness:
    """A notify action, and all its reports."""

    action: Notify
    closing: threading.Event
    outcomes: list[tuple[str, Outcome]] = field(default_factory=list)
    lost: Counter[str] = field(default_factory=Counter)
    reasons: list[str] = field(default_factory=list)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def outcome(self, episode: str, state: OutcomeState = OutcomeState.DONE) -> Outcome:
        """The episode's outcome with this state, once it is reported."""
        return self.until(lambda: next((o for e, o in self.outcomes if e == episode and o.state is state), None))

    def until(self, get: Callable[[], Any]) -> Any:
        with self.changed:
            assert self.changed.wait_for(get, PATIENCE), (self.outcomes, self.lost, self.reasons)
            return get()

    def run(self, *episodes: Episode) -> None:
        """Whole episodes, one after the other."""
        for episode in episodes:
            self.action.started(replace(episode, ended=None, end_time=None, reason=None))
            self.action.ended(episode)
            self.action.completed(episode, Completion())

    def end(self) -> None:
        """Close the action, as at the end of the detector."""
        self.closing.set()
        self.action.close()


def a_harness(notify: Mapping[str, Any], *, state: Path | None = None, messenger: Any = None) -> Harness:
    parameters = Parameters.model_validate(notify)
    rule = a_rule("braking", when="true", actions=[{"name": "notify", "notify": dict(notify)}])
    detector = a_detector(**({} if state is None else {"state": {"path": str(state)}}))
    harness = Harness.__new__(Harness)

    def report(episode: Episode, outcome: Outcome) -> None:
        with harness.changed:
            harness.outcomes.append((episode.id, outcome))
            harness.changed.notify_all()

    def lose(what: str, count: int, why: str) -> None:
        with harness.changed:
            harness.lost[what] += count
            harness.reasons.append(why)
            harness.changed.notify_all()

    harness.closing, harness.outcomes, harness.lost, harness.reasons = threading.Event(), [], Counter(), []
    harness.changed = threading.Condition()
    context = ActionContext(
        rule=rule,
        action="notify",
        holder="h",
        configuration=lambda: DetectorConfiguration(detector, {}, standard()),
        messenger=messenger or NoMessenger(),
        report=report,
        lose=lose,
        closing=harness.closing,
    )
    harness.action = Notify(parameters, context)
    return harness


def an_episode(
    name: str = "e1", client: str = "car1", rendered: Mapping[str, Any] | None = None, **fields: Any
) -> Episode:
    """An episode that has ended, five seconds after its start."""
    times = {"onsetTime": format_time(START), "startTime": format_time(START)}
    data = {"rule": "braking", "episode": name, "subjects": [client], **times, "values": {"speed": 12.5}}
    end = START + 5 * SECOND
    return Episode(
        id=name,
        rule="braking",
        subject=client,
        clients=(client,),
        element=None,
        onset_time=START,
        start_time=START,
        values={"speed": 12.5},
        classification=None,
        rendered=rendered or {},
        unrendered=fields.pop("unrendered", {}),
        started=_event(name, client, "started", START, data),
        resumed=fields.pop("resumed", False),
        end_time=end,
        reason="Until",
        ended=_event(name, client, "ended", end, {**data, "endTime": format_time(end), "reason": "Until"}),
        **fields,
    )


def _event(name: str, client: str, what: str, time: int, data: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "specversion": "1.0",
        "id": f"{name}.{what}",
        "source": "/detectors/h",
        "type": f"dev.wayside.event.{what}",
        "subject": client,
        "time": format_time(time),
        "datacontenttype": "application/json",
        "data": dict(data),
    }
