"""How news comes in: lists, watches and Leases that are looked at, and what each piece of news means."""
