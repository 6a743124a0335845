"""Lists stay current, however their watch ends."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cluster.api import Api
from tests.cluster.background import Background, background
from tests.cluster.controlplane import ControlPlane
from tests.cluster.waiting import wait_until
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.reflector import Change, Changed, Deleted, Reflector, Replaced
from wayside.kubernetes.resources import Object, Resource

CONFIG_MAPS = Resource("v1", "ConfigMap", "configmaps")
MARKED = "test=yes"


@pytest.fixture
def loop(control_plane: ControlPlane) -> Iterator[Background]:
    with background(control_plane.kubeconfig) as started:
        yield started


class ReflectorReader:
    """Keeps what a reflector yields, and the resulting state."""

    def __init__(self, loop: Background, namespace: str, resync: float = 600.0):
        self.changes: list[Change] = []
        self.data: dict[str, str] = {}
        self.reflector = Reflector(loop.api, CONFIG_MAPS, namespace, labels=MARKED, resync=resync)
        loop.start(self._follow())

    async def _follow(self) -> None:
        async for change in self.reflector.follow():
            match change:
                case Replaced(objects, _):
                    self.data = {name(each): each["data"]["x"] for each in objects}
                case Changed(each):
                    self.data[name(each)] = each["data"]["x"]
                case Deleted(each):
                    del self.data[name(each)]
            self.changes.append(change)

    def wait(self, **data: str) -> None:
        wait_until(lambda: dict(self.data), lambda found: found == data, what=f"known: {data}")


def name(obj: Object) -> str:
    return str(obj["metadata"]["name"])


def config_map(named: str, x: str, marked: str = "yes") -> Object:
    metadata = {"name": named, "labels": {"test": marked}}
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata, "data": {"x": x}}


def test_creations_changes_and_deletions_arrive_without_another_list(
    api: Api, namespace: str, loop: Background
) -> None:
    api.create(config_map("a", "1"))
    api.create(config_map("other", "1", marked="no"))
    following = ReflectorReader(loop, namespace)
    following.wait(a="1")
    api.create(config_map("b", "1"))
    api.patch("ConfigMap", "a", {"data": {"x": "2"}})
    following.wait(a="2", b="1")
    api.delete("ConfigMap", "a")
    api.patch("ConfigMap", "b", {"metadata": {"labels": {"test": "no"}}})
    following.wait()
    assert following.reflector.lists == 1


def test_all_is_listed_again_after_the_resync_period(api: Api, namespace: str, loop: Background) -> None:
    api.create(config_map("a", "1"))
    following = ReflectorReader(loop, namespace, resync=1.0)
    wait_until(lambda: following.reflector.lists, lambda n: n >= 3, what="three lists")
    assert following.reflector.outages == 0
    assert following.data == {"a": "1"}


@pytest.mark.own_control_plane
def test_changes_around_an_outage_are_not_missed(
    control_plane: ControlPlane, api: Api, namespace: str, loop: Background
) -> None:
    api.create(config_map("a", "1"))
    api.create(config_map("b", "1"))
    following = ReflectorReader(loop, namespace)
    following.wait(a="1", b="1")
    control_plane.stop_api_server()
    try:
        wait_until(lambda: following.reflector.outages, bool, what="the outage was noticed")
    finally:
        control_plane.start_api_server()
    api.delete("ConfigMap", "a")
    api.patch("ConfigMap", "b", {"data": {"x": "2"}})
    following.wait(b="2")


@pytest.mark.own_control_plane
def test_an_expired_resource_version_is_reported_as_such(
    control_plane: ControlPlane, api: Api, namespace: str, loop: Background
) -> None:
    old = api.create(config_map("a", "1"))["metadata"]["resourceVersion"]
    for x in "23":
        api.patch("ConfigMap", "a", {"data": {"x": x}})
    with control_plane.outage():
        pass  # a fresh API server has the current objects but no history

    async def watch() -> None:
        while True:
            try:
                async for _ in loop.api.watch(CONFIG_MAPS, namespace, labels=MARKED, since=old, seconds=2.0):
                    pass
            except Unreachable:
                pass
            except ApiError as error:
                if error.permanent:
                    raise  # else the API server requests a retry while it fills its cache

    with pytest.raises(ApiError, match="too old resource version") as gone:
        loop.call(watch())
    assert gone.value.code == 410
