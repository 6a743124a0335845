"""The timeouts of tests. A test that passes does not wait for them."""

from __future__ import annotations

PATIENCE = 120.0
"""Seconds for whatever has no speed that the test checks: it only bounds a hang. A machine that is many times slower
than usual still passes."""

NODE_PATIENCE = 300.0
"""The same for what runs in containers on a real node."""
