"""Which samples an action gets of an episode: streams, clients, and how long before and after it."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from wayside.api.base import ClientName, Duration, Model, ObjectName


class WindowClients(StrEnum):
    """Whose samples an action gets."""

    SUBJECTS = "Subjects"
    ALL = "All"


class Window(Model):
    """Samples around an episode. Those of latched streams, such as /tf_static, always come with them."""

    streams: list[ObjectName] | None = Field(
        default=None,
        min_length=1,
        max_length=128,
        description="The streams. Default: all of the Detector. Latched ones always come with them.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    clients: WindowClients = Field(
        default=WindowClients.SUBJECTS,
        description="Subjects: the clients that the episode is about; of a fleet rule, all. All: every client.",
    )
    with_clients: list[ClientName] = Field(
        default_factory=list,
        max_length=64,
        description="Further clients, such as the roadside unit that looks on.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    before: Duration = Field(
        default=Duration("0s"),
        description="From so long before the onset, when the condition began to hold. Together with the rule's `for` "
        "it must not exceed what is kept of the streams.",
    )
    after: Duration = Field(default=Duration("0s"), description="Until so long after the episode's end.")
