"""The writing state of an episode: its scenario, or with `renewAfter` one scenario after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from detector.actions.database.documents import Documents
from detector.actions.database.scenario import Scenario
from detector.actions.episode import Episode, EpisodeSample


@dataclass(slots=True)
class Writing:
    """An episode's current scenario, and the totals of the previous ones."""

    episode: Episode
    scenario: Scenario
    documents: Documents
    latched: frozenset[str]
    """The streams whose last samples each scenario receives."""
    renew_after: int | None
    """Nanoseconds."""
    seam: int | None = None
    """Samples from this time on belong to the next scenario; None while this is unknown."""
    latest: dict[tuple[str, str, str], EpisodeSample] = field(default_factory=dict)
    """The newest samples of latched streams."""
    trouble: str = ""
    """Why a previous scenario is incomplete; the first reason."""
    undecoded: int = 0
    scenarios: int = 1
    messages: Counter[str] = field(default_factory=Counter)
    """Of the previous scenarios, like bytes, files and lost."""
    bytes: int = 0
    files: int = 0
    lost: int = 0

    def parted(self, samples: Sequence[EpisodeSample]) -> tuple[Sequence[EpisodeSample], Sequence[EpisodeSample]]:
        """The samples of the current scenario, and those of later ones."""
        if self.renew_after is None:
            return samples, ()
        own = [sample.time for sample in samples if sample.stream not in self.latched]
        if self.seam is None and own:
            self.seam = min(own) + self.renew_after
        seam = self.seam
        now = [sample for sample in samples if seam is None or sample.time < seam]
        rest = [sample for sample in samples if seam is not None and sample.time >= seam]
        for sample in now:
            if sample.stream in self.latched:
                self.latest[sample.client, sample.stream, sample.key] = sample
        return now, rest

    def go_on(self, scenario: Scenario, documents: Documents) -> None:
        """The current scenario has all its samples: switch to the next one."""
        self.messages += self.scenario.messages
        self.bytes += self.scenario.bytes
        self.files += self.scenario.files
        self.lost += sum(self.scenario.lost.values())
        self.scenarios += 1
        self.scenario, self.documents, self.seam = scenario, documents, None
