"""A server that speaks MongoDB's protocol over TCP, for tests and benchmarks.

Where it comes from, in this order:

1. one that runs: `MONGODB_URI`;
2. `mongod` on the PATH, which is started;
3. FerretDB as a library with its SQLite files (the Go module in `server/`, pinned by its go.sum), built once into the
   cache `${XDG_CACHE_HOME:-~/.cache}/wayside/mongodb/<hash>/`. `python -m tests.mongodb` builds it and prints its path.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pymongo
from pymongo.errors import PyMongoError
from rich.console import Console

from tests.cluster.toolchain import GoUnavailableError, find_go
from tests.gobuild import locked
from tests.ports import free_port

MODULE = Path(__file__).parent / "server"
BUILD_FLAGS = ("-trimpath", "-buildvcs=false", "-ldflags", "-s -w")


class ServerUnavailableError(Exception):
    """There is no server and none can be built; the message says what to do."""


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
    console = console or Console(stderr=True)
    program = cache_folder() / "mongodb"
    if program.is_file():
        return program
    program.parent.mkdir(parents=True, exist_ok=True)
    with locked(program.parent / ".lock"):
        if not program.is_file():
            _build(program, console)
    return program


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """The folder of the program that is built from the present source, flags and platform."""
    digest = hashlib.sha256()
    for part in (
        *((MODULE / name).read_bytes() for name in ("go.mod", "go.sum", "main.go")),
        "\0".join(BUILD_FLAGS).encode(),
        f"{platform.system()}/{platform.machine()}".encode(),
    ):
        digest.update(len(part).to_bytes(8, "big") + part)
    base = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "wayside" / "mongodb" / digest.hexdigest()[:16]


def _build(program: Path, console: Console) -> None:
    remedy = "set MONGODB_URI to a server that you have, or put mongod on the PATH"
    try:
        go = find_go(program.parent.parent.parent / "controlplane" / "go", console)
    except GoUnavailableError as error:
        raise ServerUnavailableError(
            f"a MongoDB server has to be built, which needs Go ({error}); or {remedy}"
        ) from error
    unfinished = program.with_name(f".mongodb.{os.getpid()}")
    console.print("building a MongoDB server (FerretDB, once; about a minute)", highlight=False)
    began = time.monotonic()
    environment = os.environ | {"CGO_ENABLED": "0", "GOTOOLCHAIN": "local", "GOWORK": "off"}
    command = [str(go), "build", *BUILD_FLAGS, "-o", str(unfinished), "."]
    try:
        done = subprocess.run(command, cwd=MODULE, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ServerUnavailableError(f"building it failed; {remedy}:\n{(done.stdout + done.stderr)[-4000:]}")
        unfinished.rename(program)
    finally:
        unfinished.unlink(missing_ok=True)
    console.print(f"built it in {time.monotonic() - began:.0f} s", highlight=False)


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
