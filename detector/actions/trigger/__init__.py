"""The trigger action: another system records while an episode lasts."""
