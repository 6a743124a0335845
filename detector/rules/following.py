"""The Detector and its rules from files, read again on SIGHUP: a detector without a cluster changes while it runs."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

from detector.rules.files import Check, load_rules
from detector.rules.selection import RuleSet
from wayside.api.documents import DocumentError

_log = logging.getLogger(__name__)


async def follow_files(detector: Path, rules: Sequence[Path], check: Check) -> AsyncIterator[RuleSet]:
    """What the files say, at each SIGHUP. Files that are wrong are said, and change nothing."""
    changed = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGHUP, changed.set)
    try:
        while True:
            await changed.wait()
            changed.clear()
            try:
                loaded = load_rules(detector, rules, check)
            except (DocumentError, OSError) as error:
                _log.error("the files are not followed, what was good goes on: %s", error)
                continue
            for warning in loaded.warnings:
                _log.warning("%s", warning)
            _log.info("the files are read again: %d rules", len(loaded.rule_set.rules))
            yield loaded.rule_set
    finally:
        loop.remove_signal_handler(signal.SIGHUP)
