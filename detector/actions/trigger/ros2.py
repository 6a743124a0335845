"""Services of ROS 2 over Zenoh, such as those of rosbag2's recorder.

With rmw_zenoh (its docs/design.md) a service is a queryable on `<domain>/<service>/<type>/<type hash>`; a query carries
the request as CDR and an attachment: its number and time (8 bytes each, little endian), and the id of the client (a
length of one byte, then 16 bytes). The type hash is the service's, so a node with a different definition of the service
is not reached. With zenoh-bridge-ros2dds it is a queryable on the service's name, and needs no attachment.

A service does not distinguish episodes: if it is both started and stopped, all episodes of the action share one
recording.
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import count
from typing import Any

from detector.actions.base import ActionError, Messenger
from detector.actions.trigger.requests import Order, Progress, Report, nested_value
from detector.actions.trigger.services import ServiceError, service
from detector.streams.codecs.definitions import Definition, DefinitionsError
from detector.streams.codecs.ros import RosTypes, types_with
from wayside.api import Detector
from wayside.api.actions.trigger import ServiceCall, TriggerAction
from wayside.api.stream import Layout
from wayside.api.validation_errors import FieldPath


class Ros2Services:
    """Calls one service when the episode starts, and one when it ends."""

    renew: float | None = None
    ends_by_itself = False

    def __init__(self, parameters: TriggerAction, messenger: Messenger, types: Callable[[], RosTypes]) -> None:
        assert parameters.ros2 is not None  # noqa: S101  the caller checked it
        self._wanted = parameters.ros2
        self.timeout = parameters.timeout.seconds
        self._messenger = messenger
        self._types = types
        self._client_id = os.urandom(16)
        self._numbers = count(1)
        self._recording: set[str] = set()
        """The orders for which the recorder has been started."""
        self._unanswered: set[tuple[str, str]] = set()
        """Orders whose call was sent without a response, with the call's name."""

    def place(self, order: Order) -> str:
        """The first of the services: if it does not respond, neither does the other."""
        return next(iter(self._wanted.calls.values())).service

    def start(self, order: Order, ago: float, *, again: bool) -> Report:
        """Call `start`, unless another episode has done so."""
        shared = self._wanted.stop is not None and bool(self._recording)
        if self._wanted.start is not None and not shared:
            if again:
                self._unanswered.add((order.id, "start"))
            report = self._call("start", self._wanted.start, order)
            if report is not None:
                return report
        self._recording.add(order.id)
        return Report(Progress.RECORDING, "the recorder already runs for another episode" if shared else "")

    def stop(self, order: Order, ago: float) -> Report:
        """Call `stop`, unless another episode is still open."""
        shared = self._wanted.start is not None and bool(self._recording - {order.id})
        if self._wanted.stop is not None and not shared:
            report = self._call("stop", self._wanted.stop, order)
            if report is not None:
                return report
        self._recording.discard(order.id)
        return Report(Progress.DONE, "the recorder keeps running for another episode" if shared else "")

    def status(self, order: Order) -> Report:
        """There is no more information than in the responses."""
        return Report(Progress.RECORDING if order.id in self._recording else Progress.DONE)

    def _call(self, name: str, call: ServiceCall, order: Order) -> Report | None:
        """None if it succeeded."""
        key, fields = (order.id, name), self._request(name, order)
        try:
            of_type = service(call.type, call.definition, self._types())
            request = of_type.request(fields)
        except ServiceError as error:
            return Report(Progress.REFUSED, f"ros2.{name}: {error}")
        topic = call.service.lstrip("/")
        attachment = None
        if self._wanted.layout is Layout.RMW_ZENOH:
            package, _, short = call.type.split("/")
            topic = f"{self._wanted.domain or 0}/{topic}/{package}::srv::dds_::{short}_/{of_type.type_hash}"
            attachment = (
                struct.pack("<qqB", next(self._numbers), time.time_ns(), len(self._client_id)) + self._client_id
            )
        try:
            answers = self._messenger.query(topic, request, self.timeout, attachment)
            response = of_type.response(answers[0])
        except ActionError as error:
            self._unanswered.add(key)
            raise ActionError(f"{call.service} ({call.type}): {error}") from error
        except (IndexError, ServiceError) as error:
            raise ActionError(f"{call.service}: {error}") from error
        refusal = _refusal(response)
        repeated = key in self._unanswered
        self._unanswered.discard(key)
        if refusal is None or (repeated and "return_code" in response):
            # rosbag2 also returns 1 if it is already in the requested state: then an earlier call had arrived.
            return None
        return Report(Progress.REFUSED, f"{call.service} refused: {refusal}")

    @staticmethod
    def _request(name: str, order: Order) -> Mapping[str, Any]:
        value = nested_value(order.rendered, "ros2", name, "request")
        return value if isinstance(value, Mapping) else {}


def _refusal(response: Mapping[str, Any]) -> str | None:
    """Why the service refused, in the words of rosbag2 and std_srvs; None if it succeeded."""
    if response.get("success", True) is not False and response.get("return_code", 0) == 0:
        return None
    why = response.get("error_string") or response.get("message")
    return str(why or f"return code {response.get('return_code', 'none')}, success {response.get('success', 'none')}")


def call_problems(parameters: TriggerAction, detector: Detector) -> Iterator[tuple[FieldPath, str]]:
    """The problems of the calls, as far as they are known without an episode."""
    if parameters.ros2 is None:
        return
    try:
        types = types_with(tuple(Definition(each.name, each.definition) for each in detector.spec.messages))
    except DefinitionsError:  # a problem of the Detector, and reported there
        return
    for name, call in parameters.ros2.calls.items():
        field = "definition"
        try:
            of_type = service(call.type, call.definition, types)
            field = "request"
            of_type.request({key: value for key, value in call.request.items() if "${" not in json.dumps(value)})
        except ServiceError as error:
            if call.definition is None and field == "definition":
                field = "type"
            yield ("ros2", name, field), str(error)
