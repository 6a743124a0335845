"""A Detector and its EventRules from the API server, watched for changes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator
from typing import Generic, TypeVar

from detector.resources.selection import RuleSet, select
from wayside.api import API_VERSION, Detector, EventRule, Kind
from wayside.api.documents import parse_object
from wayside.kubernetes.client import Client
from wayside.kubernetes.reflector import Change, Changed, Deleted, Reflector, Replaced
from wayside.kubernetes.resources import Object, Resource

_log = logging.getLogger(__name__)

PROGRAM = "wayside-detector"
"""The name of the detector for the API server."""

DETECTORS = Resource(API_VERSION, Detector.__name__, Detector.plural)
EVENT_RULES = Resource(API_VERSION, EventRule.__name__, EventRule.plural)

_RESYNC = 30.0
"""Seconds after which all is listed again, even if nothing seems to be missing."""

_COALESCING = 0.05
"""Seconds: changes of one `kubectl apply` take effect together."""

Parsed = TypeVar("Parsed", bound=Kind)


class ClusterRules:
    """The Detector of this name and the rules that it selects, kept current.

    While the API server is unavailable, or the Detector is missing or unreadable, the last known set stays in use. An
    unreadable rule (e.g. of a newer version) is reported and left out; the others are not affected.
    """

    def __init__(self, client: Client, namespace: str, detector_name: str) -> None:
        self._name = detector_name
        self._where = f"namespace {namespace}"
        self._detectors = _Known(Detector)
        self._rules = _Known(EventRule)
        only = f"metadata.name={detector_name}"
        self._detector_source = Reflector(client, DETECTORS, namespace, fields=only, resync=_RESYNC)
        self._rule_source = Reflector(client, EVENT_RULES, namespace, resync=_RESYNC)
        self._changed = asyncio.Event()
        self._missing = False

    @property
    def problems(self) -> dict[str, str]:
        """The unreadable objects, and the reasons, by kind and name."""
        return {
            f"{kind.__name__} {name}": why
            for kind, known in ((Detector, self._detectors), (EventRule, self._rules))
            for name, why in known.unreadable.items()
        }

    async def follow(self) -> AsyncGenerator[RuleSet, None]:
        """The set as soon as it is known, then after each change. Never ends and raises nothing."""
        last: RuleSet | None = None
        tasks = [
            asyncio.create_task(self._follow_kind(self._detector_source, self._detectors)),
            asyncio.create_task(self._follow_kind(self._rule_source, self._rules)),
        ]
        try:
            while True:
                await self._changed.wait()
                await asyncio.sleep(_COALESCING)
                self._changed.clear()
                for task in tasks:
                    if task.done():
                        task.result()  # it only ends by an error, which must not be swallowed
                current = self._current()
                if current is not None and not current.same_as(last):
                    last = current
                    yield current
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _follow_kind(self, reflector: Reflector, known: _Known[Parsed]) -> None:
        try:
            async for change in reflector.follow():
                known.apply(change)
                self._changed.set()
        finally:
            self._changed.set()

    def _current(self) -> RuleSet | None:
        if not (self._detectors.listed and self._rules.listed):
            return None
        detector = self._detectors.objects.get(self._name)
        if detector is None:
            if not self._missing and not self._detectors.unreadable:
                _log.warning(
                    "there is no Detector %r in %s: create it, or check --name and --namespace", self._name, self._where
                )
            self._missing = True
            return None
        self._missing = False
        return select(detector, self._rules.objects.values())


class _Known(Generic[Parsed]):
    """The objects of one kind, by name."""

    def __init__(self, kind: type[Parsed]) -> None:
        self._kind = kind
        self.objects: dict[str, Parsed] = {}
        self.unreadable: dict[str, str] = {}
        self.listed = False

    def apply(self, change: Change) -> None:
        match change:
            case Replaced(objects, _):
                self.listed = True
                for name in (self.objects.keys() | self.unreadable.keys()) - {
                    obj["metadata"]["name"] for obj in objects
                }:
                    self._remove(name)
                for obj in objects:
                    self._put(obj)
            case Changed(obj):
                self._put(obj)
            case Deleted(obj):
                self._remove(obj["metadata"]["name"])

    def _put(self, obj: Object) -> None:
        name = obj["metadata"]["name"]
        # The manager owns the status, and a newer manager's may have unknown fields.
        read = {key: value for key, value in obj.items() if key != "status"}
        shape = {"apiVersion": API_VERSION, "kind": self._kind.__name__}  # list items have neither
        try:
            parsed = parse_object(shape | read)
        except ValueError as error:
            if self.unreadable.get(name) != str(error):
                what = "keeping its last good version" if name in self.objects else "leaving it out"
                _log.warning("cannot read the %s %s; %s: %s", self._kind.__name__, name, what, error)
            self.unreadable[name] = str(error)
            return
        assert isinstance(parsed, self._kind)  # noqa: S101  guaranteed by the shape
        self.unreadable.pop(name, None)
        self.objects[name] = parsed

    def _remove(self, name: str) -> None:
        self.objects.pop(name, None)
        self.unreadable.pop(name, None)
