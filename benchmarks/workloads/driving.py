"""The one place where benchmarks drive the engine: as a replay does, or tick by tick as it is driven live."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from detector.assembly import RuleIndex, make_engine, stream_readers
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.engine.scoping.scopes import Evaluated
from detector.replay.replaying import replay_arrivals
from wayside.api import Detector, EventRule


class RefusedError(RuntimeError):
    """A rule of a benchmark does not compile."""


def replayed(arrivals: Sequence[Arrival], detector: Detector, rules: Sequence[EventRule]) -> list[Event]:
    """The events of a replay. Raises RefusedError."""
    outcome = replay_arrivals([arrivals], detector, rules)
    if outcome.refusals:
        raise RefusedError(str(outcome.refusals[0]))
    return outcome.events


class Live:
    """An engine whose time the caller advances."""

    def __init__(self, detector: Detector, rules: Sequence[EventRule], start: int) -> None:
        """`start`: nanoseconds since the epoch. Raises RefusedError."""
        readers = stream_readers(detector)
        compiled, refused = RuleIndex().compile(rules, detector, readers.fields)
        if refused:
            raise RefusedError(str(refused[0]))
        self._engine = make_engine(detector, readers, holder=detector.name, start=start)
        self._engine.set_rules(compiled)

    def watch(self) -> None:
        """Look at each evaluation by itself, so that no rule is evaluated in columns."""
        for run in self._engine.rules.values():
            run.on_evaluated = _nobody

    def advance(self, arrivals: Sequence[Arrival], until: int) -> list[Event]:
        """Take in what arrived, and run the ticks up to `until`, in nanoseconds since the epoch."""
        return self._engine.advance(arrivals, until)


def _nobody(_: Evaluated) -> None:
    """Looks on."""


def by_tick(arrivals: Iterable[Arrival], period: int) -> Iterator[tuple[int, list[Arrival]]]:
    """Each tick (a whole multiple of the period, in nanoseconds) and what arrived since the last one, up to its time.

    What comes after the last whole tick is left out.
    """
    tick = 0
    part: list[Arrival] = []
    for each in arrivals:
        tick = tick or -(-each.received // period) * period
        while each.received > tick:
            yield tick, part
            part, tick = [], tick + period
        part.append(each)
    if part and part[-1].received == tick:
        yield tick, part
