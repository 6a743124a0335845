"""The timeouts of tests. A test that passes does not wait for them."""

from __future__ import annotations

PATIENCE = 120.0
"""Seconds for each wait whose duration is not under test: it only limits a hang. A machine that is many times slower
than usual still passes."""

NODE_PATIENCE = 300.0
"""The same for programs in containers on a real node."""
