"""Servers that all workers of a test run share: the first that needs one starts it, and stops it after the last.

The workers of pytest-xdist are processes that know nothing of each other, so they coordinate through files in the
folder of the run. The kernel releases the file locks of a killed worker, so it blocks no other.
"""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

Server = TypeVar("Server")


def run_folder(factory: pytest.TempPathFactory) -> Path:
    """The folder that all workers of the run share; pytest keeps those of the last three runs."""
    own = factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@contextmanager
def shared(folder: Path, name: str, start: Callable[[], AbstractContextManager[Server]]) -> Iterator[Server]:
    """A server of the run: started here, or by another worker.

    Args:
        folder: of the run.
        name: of the server, as a file's name.
        start: starts it; what its context gives can be pickled, and its copy serves the other workers.
    """
    description = folder / f"{name}.pickle"
    with (folder / f"{name}.starting").open("w") as starting, (folder / f"{name}.users").open("w") as users:
        fcntl.flock(starting, fcntl.LOCK_EX)
        fcntl.flock(users, fcntl.LOCK_SH)
        if description.exists():
            fcntl.flock(starting, fcntl.LOCK_UN)
            yield pickle.loads(description.read_bytes())
            return
        with start() as server:
            description.write_bytes(pickle.dumps(server))
            fcntl.flock(starting, fcntl.LOCK_UN)
            try:
                yield server
            finally:
                fcntl.flock(users, fcntl.LOCK_EX)  # waits for all others
                description.unlink()
