"""What is known of the detectors that the manager runs: their objects as they are, and what is said of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from application_manager.cluster.store import Name, Object
from application_manager.core.conditions import Aspect
from application_manager.core.health.pods import Trouble, summary, trouble
from application_manager.core.objects.detectors import DETECTOR_LABEL
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.sidecars import SIDECAR_LABEL


@dataclass
class DetectorBook:
    """By the Detector's namespace and name.

    Attributes:
        defaults: what holds for all pods; None: no detector is run.
        objects: by kind.
        said: the condition Running.
        asking: the pods that ask for it to be in them.
    """

    defaults: PodDefaults | None = None
    objects: dict[Name, dict[str, Object]] = field(default_factory=dict)
    said: dict[Name, Aspect] = field(default_factory=dict)
    asking: dict[Name, list[Object]] = field(default_factory=dict)
    _troubles: dict[Name, list[Trouble]] = field(default_factory=dict)

    def take(self, objects: Iterable[Object], pods: Iterable[Object], asking: Iterable[Object] = ()) -> None:
        """Take all objects, their pods, and the pods that ask for detectors, as they were listed just now."""
        self.objects = {}
        for raw in objects:
            self.objects.setdefault(_detector_of(raw), {})[raw["kind"]] = raw
        found: dict[Name, list[Trouble]] = {}
        for pod in pods:
            if (each := trouble(pod)) is not None:
                found.setdefault(_detector_of(pod), []).append(each)
        self.asking = {}
        for pod in asking:
            metadata = pod["metadata"]
            self.asking.setdefault((metadata["namespace"], metadata["labels"][SIDECAR_LABEL]), []).append(pod)
        self._troubles = {name: summary(troubles) for name, troubles in found.items()}

    def troubles(self, name: Name) -> list[Trouble]:
        """The different troubles of the detector's pods, the most telling first."""
        return self._troubles.get(name, [])


def _detector_of(raw: Object) -> Name:
    metadata = raw["metadata"]
    return metadata["namespace"], metadata["labels"][DETECTOR_LABEL]
