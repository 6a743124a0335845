"""A server that speaks S3 over HTTP, with its objects in memory, for tests.

It is built from the pinned Go module in `server/` once, some ten seconds of one core, into the cache
`${XDG_CACHE_HOME:-~/.cache}/wayside/s3/<hash>/`.
"""

from __future__ import annotations

import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from tests.cluster.waiting import wait_until
from tests.gobuild import BuildError, GoModule
from tests.ports import free_port

SERVER = GoModule(
    "s3", Path(__file__).parent / "server", {"gofakes3": "github.com/johannesboyne/gofakes3/cmd/gofakes3"}
)
BUCKET = "fleet"


@contextmanager
def running() -> Iterator[dict[str, str]]:
    """The environment that clients need, as long as the context lasts; there is an empty bucket. Raises BuildError."""
    program = SERVER.ensure(Console(stderr=True)) / "gofakes3"
    address = f"127.0.0.1:{free_port()}"
    command = [program, "-backend", "memory", "-host", address, "-initialbucket", BUCKET, "-quiet"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    environment = {
        "AWS_ENDPOINT_URL": f"http://{address}",
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "somebody",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    try:
        wait_until(lambda: put(environment, "ready", b""), lambda _: True, what="S3 answers", transient=(OSError,))
        yield environment
    finally:
        process.terminate()
        process.wait()


def put(environment: dict[str, str], key: str, data: bytes) -> None:
    """Write an object of the bucket."""
    url = f"{environment['AWS_ENDPOINT_URL']}/{BUCKET}/{key}"
    with urllib.request.urlopen(urllib.request.Request(url, data, method="PUT")) as answer:
        answer.read()


def main() -> int:
    """Build what is missing."""
    try:
        print(SERVER.ensure(Console(stderr=True)))
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
