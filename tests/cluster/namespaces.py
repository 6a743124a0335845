"""A fresh namespace for each test."""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager

from tests.cluster.api import Api, ApiError, Unreachable


def new_namespace(api: Api, test: str) -> str:
    """Make a namespace named after the test, with its default service account; return its name."""
    readable = re.sub(r"[^a-z0-9]+", "-", test.removeprefix("test_").lower()).strip("-")[:40].rstrip("-")
    name = f"{readable}-{secrets.token_hex(3)}"
    api.create({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}})
    # Admission refuses pods until their account exists.
    api.wait_for("ServiceAccount", "default", lambda _: True, namespace=name, what=f"{name} has its service account")
    return name


@contextmanager
def fresh_namespace(api: Api, test: str) -> Iterator[str]:
    """A new namespace that is deleted after the block without waiting, since its pods would run on a node."""
    name = new_namespace(api, test)
    yield name
    try:
        api.delete("Namespace", name)
    except Unreachable:
        return  # a test failed while the API server was stopped: the session's data is removed soon anyway
    except ApiError as error:
        if error.code != 404:  # the test may have deleted the namespace
            raise
