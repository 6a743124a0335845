"""Results for inspection: the values of a replay between its events, as a report, as MCAP and as tables."""
