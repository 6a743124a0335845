"""The trigger action: another system records for as long as an episode lasts."""
