"""Stop and go: how often a vehicle has come to a stop lately, without counting every tremble of a standing one."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from detector.plugins import Plugin, PluginParameters, PluginSubject, Queries, Seconds, StreamName

MetresPerSecond = Annotated[float, Field(ge=0, le=100)]


class StopAndGoParameters(PluginParameters):
    """The definition of a stop."""

    stream: StreamName
    """Its messages have the speed in `v`, in m/s."""
    stopped: MetresPerSecond = 0.5
    """Below this speed a vehicle that was going has stopped."""
    going: MetresPerSecond = 3.0
    """Above this speed it is going again."""
    over: Seconds = 60.0
    """The time for which a stop counts."""


class StopAndGo(Plugin[StopAndGoParameters]):
    """The signal is the number of stops within the last `over` seconds."""

    Parameters = StopAndGoParameters

    def __init__(self, parameters: StopAndGoParameters, subject: PluginSubject) -> None:
        super().__init__(parameters, subject)
        self.is_going = False
        self.seen = 0
        self.stops: list[int] = []

    def value(self, queries: Queries, clients: tuple[str, ...]) -> float | None:
        """Look at what has come since the last evaluation; unknown while the stream is stale."""
        (client,) = clients
        if self.parameters.stream not in queries.streams(client):
            return None
        for sample in queries.between(client, self.parameters.stream, self.seen, queries.now):
            speed = sample.message["v"]
            if self.is_going and speed < self.parameters.stopped:
                self.is_going = False
                self.stops.append(sample.time)
            elif speed > self.parameters.going:
                self.is_going = True
        self.seen = queries.now
        forgotten = queries.now - self.parameters.over * 1e9
        self.stops = [stop for stop in self.stops if stop > forgotten]
        return float(len(self.stops))
