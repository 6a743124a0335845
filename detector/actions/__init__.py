"""The actions of episodes. They run beside the engine, never on its thread, and have their own counters.

For packages that provide actions: `Action`, and the types that it receives.
"""

from detector.actions.base import Action, ActionContext, ActionError, ActionParameters, DetectorConfiguration, Messenger
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState

__all__ = [
    "Action",
    "ActionContext",
    "ActionError",
    "ActionParameters",
    "Completion",
    "DetectorConfiguration",
    "Episode",
    "EpisodeSample",
    "Messenger",
    "Outcome",
    "OutcomeState",
]
