"""The actions of episodes. They run beside the engine, never on its thread, and have their own counters.

For packages that provide actions: `Action`, and the types that it receives.
"""

from detector.actions.base import Action, ActionError, ActionParameters, Messenger, Setting, Surroundings
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState

__all__ = [
    "Action",
    "ActionError",
    "ActionParameters",
    "Completion",
    "Episode",
    "EpisodeSample",
    "Messenger",
    "Outcome",
    "OutcomeState",
    "Setting",
    "Surroundings",
]
