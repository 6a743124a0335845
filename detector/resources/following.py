"""The Detector and its rules from files, read again on SIGHUP: a detector without a cluster can be reconfigured while
it runs."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

from detector.resources.files import Check, load_rules
from detector.resources.selection import RuleSet
from wayside.api.documents import DocumentError

_log = logging.getLogger(__name__)


def hangups() -> asyncio.Event:
    """An event that every SIGHUP sets from now on. Call it before the files are first read, so that no signal is
    lost."""
    changed = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, changed.set)
    return changed


async def follow_files(
    detector: Path, rules: Sequence[Path], check: Check, changed: asyncio.Event
) -> AsyncIterator[RuleSet]:
    """The content of the files each time `changed` is set. Invalid files are logged and change nothing."""
    try:
        while True:
            await changed.wait()
            changed.clear()
            try:
                loaded = load_rules(detector, rules, check)
            except (DocumentError, OSError) as error:
                _log.error("cannot watch the files; keeping the last good version: %s", error)
                continue
            for warning in loaded.warnings:
                _log.warning("%s", warning)
            _log.info("reloaded the files: %d rules", len(loaded.rule_set.rules))
            yield loaded.rule_set
    finally:
        asyncio.get_running_loop().remove_signal_handler(signal.SIGHUP)
