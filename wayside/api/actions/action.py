"""One action of a rule: its name, and exactly one kind of action."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wayside.api.actions.database import DatabaseAction
from wayside.api.actions.deploy import Deploy
from wayside.api.actions.notify import NotifyAction
from wayside.api.actions.record import RecordAction
from wayside.api.actions.trigger import TriggerAction
from wayside.api.actions.window import Window
from wayside.api.base import JsonValue, Model, ObjectName
from wayside.api.constraints import exactly_one
from wayside.api.plugin import ActionPlugin

_KINDS = ("deploy", "record", "database", "trigger", "notify", "plugin")


class ActionSpec(Model):
    """One action of an episode."""

    constraints = (exactly_one(*_KINDS),)

    name: ObjectName
    """The name of the action, unique within the rule."""
    deploy: Deploy | None = None
    """Emits an ApplicationTask that is live while the episode lasts."""
    record: RecordAction | None = None
    """Records the samples around the episode as rosbag2 with MCAP files."""
    trigger: TriggerAction | None = None
    """Makes another system record while the episode lasts."""
    database: DatabaseAction | None = None
    """Writes the samples around the episode to the Detector's database (MongoDB)."""
    notify: NotifyAction | None = None
    """Sends notifications over HTTP, to an Alertmanager or on a Zenoh key."""
    plugin: ActionPlugin | None = None
    """Runs an action plugin of an installed package."""

    @property
    def field(self) -> str:
        """The name of the field that is set, such as `deploy`."""
        return next(kind for kind in _KINDS if getattr(self, kind) is not None)

    @property
    def kind(self) -> str:
        """The name of the built-in action, or of the plugin."""
        return self.field if self.plugin is None else self.plugin.name

    @property
    def parameters(self) -> Model | Mapping[str, Any]:
        """The configuration: the model of a built-in action, or the parameters of a plugin."""
        if self.plugin is not None:
            return self.plugin.parameters
        chosen: Model = getattr(self, self.field)
        return chosen

    @property
    def window(self) -> Window | None:
        """The samples of an episode that the action receives; None: no samples."""
        chosen = getattr(self, self.field)
        if isinstance(chosen, Window):
            return chosen
        return None if self.plugin is None else self.plugin.window

    @property
    def templates(self) -> tuple[tuple[str, ...], Mapping[str, JsonValue]]:
        """The path of the field whose values are rendered for each episode, and these values by name.

        A built-in action has these values in its attribute `templates`. If they are inside one of its fields,
        `templates_in` is the path of that field.
        """
        if self.plugin is not None:
            return ("plugin", "values"), self.plugin.values
        chosen = getattr(self, self.field)
        return (self.field, *getattr(chosen, "templates_in", ())), getattr(chosen, "templates", {})
