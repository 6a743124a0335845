"""The trigger action: another system records for as long as an episode lasts."""

from detector.actions.trigger.action import Trigger

__all__ = ["Trigger"]
