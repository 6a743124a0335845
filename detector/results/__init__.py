"""Results to look at: what a replay saw between its events, as a report, as MCAP and as tables."""
