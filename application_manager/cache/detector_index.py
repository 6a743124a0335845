"""An index of the detectors that the manager runs: their objects, and whether they run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from application_manager.cache.store import MembersByGroup
from application_manager.core.conditions import ConditionState
from application_manager.core.health.pods import Trouble, summary, trouble
from application_manager.core.objects.detectors import DETECTOR_LABEL
from application_manager.core.objects.ownership import controller_of
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.policy import Name
from application_manager.core.objects.sidecars import SIDECAR_LABEL
from wayside.api import Detector
from wayside.kubernetes.resources import Object


@dataclass(frozen=True, slots=True)
class ProcessedState:
    """The condition Running of one generation of a Detector."""

    uid: str
    generation: int
    running: ConditionState


@dataclass
class DetectorIndex:
    """The Detectors by namespace and name, their objects by the uid of the controlling Detector, and by kind.

    Labels select the objects, but anybody can copy a label. So an object belongs to the Detector that controls it, and
    a pod to the Deployment whose ReplicaSet controls it.

    Attributes:
        defaults: for all pods; None: the manager runs no detectors.
        processed: the condition Running, and the version of the Detector on which it is based.
        requesting: the pods that request a Detector as a sidecar.
    """

    defaults: PodDefaults | None = None
    objects: MembersByGroup[str, str, Object] = field(default_factory=MembersByGroup)
    processed: dict[Name, ProcessedState] = field(default_factory=dict)
    requesting: dict[Name, list[Object]] = field(default_factory=dict)
    _troubles: dict[Name, list[Trouble]] = field(default_factory=dict)

    def replace(self, objects: Iterable[Object], pods: Iterable[Object], requesting: Iterable[Object] = ()) -> None:
        """Replace all objects, their pods, and the pods that request detectors, by the lists."""
        self.objects = MembersByGroup()
        deployments: set[tuple[str, str]] = set()
        for raw in objects:
            controller = controller_of(raw)
            if controller.get("kind") == "Detector":
                self.objects.put(str(controller["uid"]), raw["kind"], raw)
                if raw["kind"] == "Deployment":
                    deployments.add((raw["metadata"]["namespace"], raw["metadata"]["name"]))
        found: dict[Name, list[Trouble]] = {}
        for pod in pods:
            if _deployment_of(pod) in deployments and (each := trouble(pod)) is not None:
                found.setdefault(_detector_of(pod, DETECTOR_LABEL), []).append(each)
        self.requesting = {}
        for pod in requesting:
            self.requesting.setdefault(_detector_of(pod, SIDECAR_LABEL), []).append(pod)
        self._troubles = {name: summary(troubles) for name, troubles in found.items()}

    def running(self, detector: Detector) -> ConditionState | None:
        """The condition Running of this generation of the Detector; None if it was not processed yet."""
        known = self.processed.get((detector.namespace, detector.name))
        metadata = detector.metadata
        if known is None or (known.uid, known.generation) != (metadata.uid, metadata.generation):
            return None
        return known.running

    def owned(self, uid: str) -> Mapping[str, Object]:
        """The objects that the Detector of this uid controls, by kind."""
        return self.objects.get(uid, {})

    def troubles(self, name: Name) -> list[Trouble]:
        """The distinct problems of the detector's pods, the most important first."""
        return self._troubles.get(name, [])


def _deployment_of(pod: Object) -> tuple[str, str] | None:
    """The name of the Deployment whose ReplicaSet controls the pod: the ReplicaSet's name without the hash."""
    metadata, controller = pod["metadata"], controller_of(pod)
    ending = f"-{metadata['labels'].get('pod-template-hash', '')}"
    if controller.get("kind") != "ReplicaSet" or not str(controller["name"]).endswith(ending):
        return None
    return metadata["namespace"], str(controller["name"]).removesuffix(ending)


def _detector_of(pod: Object, label: str) -> Name:
    return pod["metadata"]["namespace"], pod["metadata"]["labels"][label]
