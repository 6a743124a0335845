"""Properties that these tests rely on: messages of failures, and pods that keep the status a test sets."""

from __future__ import annotations

import json
import os

import pytest

from tests.cluster.api import Api
from tests.cluster.binaries import VERSION
from tests.cluster.expected_objects import deployment
from tests.cluster.pods import mark_pods_ready


def test_marking_pods_twice_changes_nothing(api: Api) -> None:
    api.apply(deployment(name="app"))
    api.wait_list("Pod", lambda pods: len(pods) == 1, what="a pod exists")
    mark_pods_ready(api)
    first = api.list("Pod")
    assert mark_pods_ready(api) == []
    assert api.list("Pod") == first


def test_the_control_plane_has_the_requested_version(api: Api) -> None:
    chosen = "v1.31.0" if os.environ.get(VERSION) == "oldest" else "v1.36.3"
    assert json.loads(api.raw("/version"))["gitVersion"] == chosen


def test_an_unknown_kind_is_named(api: Api) -> None:
    with pytest.raises(LookupError, match="no kind 'Deploymnt'"):
        api.list("Deploymnt")


def test_a_wait_that_fails_shows_the_last_state(api: Api) -> None:
    with pytest.raises(TimeoutError, match=r'(?s)still not: it is green\. Last seen:.*"name": "default"'):
        api.wait_for("ServiceAccount", "default", lambda _: False, timeout=0.1, what="it is green")
