"""A server that speaks MongoDB's protocol over TCP, for tests and benchmarks.

Where it comes from, in this order:

1. one that runs: `MONGODB_URI`;
2. `mongod` on the PATH, which is started;
3. FerretDB as a library with its SQLite files (the Go module in `server/`, pinned by its go.sum), built once into the
   cache `${XDG_CACHE_HOME:-~/.cache}/wayside/mongodb/<hash>/`. `python -m tests.mongodb` builds it and prints its path.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pymongo
from pymongo.errors import PyMongoError
from rich.console import Console

from tests.gobuild import BuildError, GoModule
from tests.ports import free_port

SERVER = GoModule("mongodb", Path(__file__).parent / "server", {"mongodb": "."})


class ServerUnavailableError(Exception):
    """There is no server and none can be built; the message gives the remedy."""


@dataclass(frozen=True)
class MongoServer:
    """A server that runs."""

    uri: str
    kind: str
    """What it is, e.g. FerretDB."""

    @property
    def host(self) -> str:
        return self.uri.partition("://")[2].rpartition("@")[2].partition("/")[0].partition(",")[0].partition(":")[0]

    @property
    def port(self) -> int:
        found = self.uri.partition("://")[2].rpartition("@")[2].partition("/")[0].partition(",")[0].partition(":")[2]
        return int(found or 27017)


@contextmanager
def running(folder: Path | None = None) -> Iterator[MongoServer]:
    """A server as long as the context lasts; its data lies in the folder. Raises ServerUnavailableError."""
    if uri := os.environ.get("MONGODB_URI"):
        yield MongoServer(uri, "MONGODB_URI")
        return
    with tempfile.TemporaryDirectory() as temporary:
        data = folder or Path(temporary)
        data.mkdir(parents=True, exist_ok=True)
        port = free_port()
        if mongod := shutil.which("mongod"):
            kind = "mongod"
            command = [mongod, "--bind_ip", "127.0.0.1", "--port", str(port), "--dbpath", str(data)]
        else:
            kind, command = "FerretDB", [str(ensure_server()), f"127.0.0.1:{port}", str(data)]
        with (data / "log").open("ab") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
            try:
                server = MongoServer(f"mongodb://127.0.0.1:{port}/", kind)
                _wait(server, process, data / "log")
                yield server
            finally:
                process.kill()


def _wait(server: MongoServer, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + 180
    with pymongo.MongoClient[dict[str, object]](server.uri, serverSelectionTimeoutMS=50) as client:
        while True:
            try:
                client.admin.command("ping")
                return
            except PyMongoError as error:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise ServerUnavailableError(f"{server.kind} does not start:\n{log.read_text()[-2000:]}") from error


def ensure_server(console: Console | None = None) -> Path:
    """The program, built if it is not in the cache. Raises ServerUnavailableError."""
    try:
        return SERVER.ensure(console or Console(stderr=True)) / "mongodb"
    except BuildError as error:
        remedy = "set MONGODB_URI to a server that you have, or put mongod on the PATH"
        raise ServerUnavailableError(f"there is no MongoDB server; {remedy}. {error}") from error


def main() -> int:
    """Build the server where it is needed."""
    if os.environ.get("MONGODB_URI") or shutil.which("mongod"):
        return 0
    try:
        print(ensure_server())
    except ServerUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
