"""The Lease of a holder, as both programs know it: its name and its default duration."""

from __future__ import annotations

PREFIX = "wayside-"
"""The prefix of the names of all holders' Leases."""

HOLDER_LEASE_LABEL = "wayside.dev/holder-lease"
"""On all holders' Leases, with the value `true`: the manager watches these alone, and not those of every node."""

DEFAULT_DURATION = 15.0
"""The default duration of a Lease, in seconds, if the Lease does not specify one."""


def lease_name(holder: str) -> str:
    """The name of the holder's Lease."""
    return PREFIX + holder


def holder_of(name: str) -> str | None:
    """Whose Lease has this name; None where it is no holder's."""
    return name.removeprefix(PREFIX) if name.startswith(PREFIX) else None
