"""The samples of an episode that an action receives: streams, clients, and the time before and after."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from wayside.api.base import SET_LIST, ClientName, Duration, Model, ObjectName


class WindowClients(StrEnum):
    """The clients whose samples an action receives."""

    SUBJECTS = "Subjects"
    ALL = "All"


class Window(Model):
    """Samples around an episode. Samples of latched streams, such as /tf_static, are always included."""

    streams: list[ObjectName] | None = Field(default=None, min_length=1, max_length=128, json_schema_extra=SET_LIST)
    """The streams to include. Latched streams are always included. Default: all streams of the Detector."""
    clients: WindowClients = WindowClients.SUBJECTS
    """Subjects: the clients of the episode (in a fleet scope: all clients). All: every client."""
    with_clients: list[ClientName] = Field(default_factory=list, max_length=64, json_schema_extra=SET_LIST)
    """Additional clients, such as a roadside unit that observes the scene."""
    before: Duration = Duration("0s")
    """The length of the window before the onset. Together with the rule's `for`, it must not exceed the buffer duration
    of the streams."""
    after: Duration = Duration("0s")
    """The length of the window after the end of the episode."""
