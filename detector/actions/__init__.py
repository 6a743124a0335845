"""What episodes lead to. Actions run beside the engine, never on its thread, and keep what they count.

For packages that bring actions of their own: `Action`, and what it is given.
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
