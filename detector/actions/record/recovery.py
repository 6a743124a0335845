"""Recovers the recordings of a killed process: at the next start they are completed, marked as cut, and renamed."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from detector.actions.record.bag import BagFile
from detector.actions.record.description import METADATA_CUT, METADATA_END, ending, with_ending
from detector.actions.record.destination import DROPPED, PARTIAL, Destination, Kept, hidden
from detector.actions.record.folder import RecordingFolder
from detector.actions.record.salvage import contents_of, salvage

log = logging.getLogger(__name__)

REASON = "the detector was killed while it recorded"
"""The reason that such recordings are marked with."""


def recover(destination: Destination, left: Iterable[Path]) -> list[Kept]:
    """Completes the recordings in these hidden folders; one that another process has locked is in progress and left
    alone.

    Recordings that cannot be completed are left unchanged, and logged.
    """
    for path in hidden(destination.path, DROPPED):
        shutil.rmtree(path, ignore_errors=True)
    kept = []
    for path in left:
        try:
            recording = _recovered(destination, path)
        except BlockingIOError:
            continue
        except OSError as error:
            log.error("%s: cannot complete the interrupted recording: %s", path, error)
            continue
        if recording is not None:
            log.warning("%s: %s; completed the recording with the data that was written", recording.path, REASON)
            kept.append(recording)
    return kept


def _recovered(destination: Destination, path: Path) -> Kept | None:
    name = path.name.removeprefix(".").removesuffix(PARTIAL)
    folder = RecordingFolder(destination, path, name, lambda dropped: None, forced=True)
    files = sorted(path.glob("*.mcap"), key=lambda each: int(each.stem.rpartition("_")[2]))
    folder.claim(sum(each.stat().st_size for each in path.iterdir()), 0, len(files))
    folder.use_room()
    fields = folder.described()
    try:
        last = files[-1:]
        found = () if fields is None else ((_part(file, folder, fields, file in last)) for file in files)
        parts = [part for part in found if part is not None]
        samples = sum(part.contents.messages for part in parts)
        if fields is None or not samples:
            folder.remove()
            return None
        return folder.publish(
            parts, with_ending(fields, cut=REASON, samples=samples, files=[part.name for part in parts])
        )
    except OSError:
        folder.leave()
        raise


def _part(path: Path, folder: RecordingFolder, fields: dict[str, Any], last: bool) -> BagFile | None:
    """The completed file; None if nothing in it can be read: it is deleted.

    The last file is checked even if it seems complete: the disk may not have received all of it.
    """
    contents = None if last else contents_of(path)
    if contents is None:
        file = salvage(path, folder.claim)
        if file is None or not file.contents.messages:
            if file is not None:
                file.give_up()
            path.unlink()
            return None
        try:
            file.add_metadata(METADATA_CUT, {"reason": REASON})
            file.add_metadata(METADATA_END, ending(with_ending(fields, cut=REASON, samples=file.contents.messages)))
            file.finish()
        finally:
            file.give_up()
        contents = file.contents
    return BagFile(path.name, contents)
