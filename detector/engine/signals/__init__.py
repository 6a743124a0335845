"""The inputs of conditions: aggregates of samples, episodes of other rules, models."""
