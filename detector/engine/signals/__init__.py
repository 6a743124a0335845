"""The values that conditions are over: aggregates of samples, episodes of other rules, models."""
