"""Shared fixtures: a MongoDB server, free endpoints, an authority, an HTTP endpoint."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pymongo
import pytest

from tests.certificates import Authority
from tests.http_servers import Endpoint
from tests.http_servers import endpoint as http_endpoint
from tests.mongodb import MongoServer, running
from tests.mongodb.proxy import ServerProxy
from tests.networks import Arrivals
from tests.ports import free_endpoint
from tests.process.database_harness import Harness, MakeHarness
from tests.sharing import run_folder, shared


@pytest.fixture(scope="session")
def mongodb(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MongoServer]:
    with shared(run_folder(tmp_path_factory), "mongodb", running) as started:
        yield started


@pytest.fixture
def name() -> str:
    """The URI of a database that no other test uses."""
    return f"t{uuid.uuid4().hex[:16]}"


@pytest.fixture
def database(mongodb: MongoServer, name: str) -> Iterator[Any]:
    with pymongo.MongoClient[dict[str, Any]](mongodb.uri) as client:
        yield client[name]
        client.drop_database(name)


@pytest.fixture
def proxy(mongodb: MongoServer) -> Iterator[ServerProxy]:
    made = ServerProxy(mongodb)
    yield made
    made.cut()


@pytest.fixture
def harness(proxy: ServerProxy, name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[MakeHarness]:
    monkeypatch.setenv("TEST_MONGODB_URI", proxy.uri)
    made: list[Harness] = []

    def make(
        spool: int | None = None,
        streams: Any = (),
        files: bool = False,
        above: str = "64Ki",
        concern: str = "Majority",
        **parameters: Any,
    ) -> Harness:
        place: dict[str, Any] = {"uriVariable": "TEST_MONGODB_URI", "writeConcern": concern}
        if spool is not None:
            place["spool"] = {"path": str(tmp_path / "spool"), "bytes": str(spool)}
        if files:
            place["files"] = {"path": str(tmp_path / "files")}
            parameters["files"] = {"above": above}
        made.append(Harness(place, name, streams, **parameters))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def arrivals() -> Arrivals:
    return Arrivals()


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


@pytest.fixture
def there() -> Iterator[Endpoint]:
    with http_endpoint() as made:
        yield made
