"""What both programs know of a holder's Lease: how it is called, and how long a renewal of it holds."""

from __future__ import annotations

PREFIX = "wayside-"
"""What the names of all holders' Leases begin with."""

HOLDER_LEASE_LABEL = "wayside.dev/holder-lease"
"""On all holders' Leases, with the value `true`: the manager watches these alone, and not those of every node."""

DEFAULT_DURATION = 15.0
"""Seconds that a renewal holds, where the Lease does not say."""


def lease_name(holder: str) -> str:
    """The name of the holder's Lease."""
    return PREFIX + holder


def holder_of(name: str) -> str | None:
    """Whose Lease has this name; None where it is no holder's."""
    return name.removeprefix(PREFIX) if name.startswith(PREFIX) else None
