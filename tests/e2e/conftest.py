"""The fixtures of the tests on a real node: one node, one namespace for each test, one test at a time.

Every test in this folder has the marker `e2e`. They are skipped where the machine cannot run a node: where
the tests do not run as root, or in a container without privileges. Elsewhere, a missing dependency is a failure.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from tests.cluster.api import Api
from tests.cluster.binaries import ensure_binaries
from tests.cluster.crds import CRDS
from tests.cluster.namespaces import fresh_namespace
from tests.e2e.images import WAYSIDE_IMAGE, wayside_archive
from tests.e2e.node import Node
from tests.e2e.privileges import why_no_node
from tests.e2e.programs import ensure_programs
from tests.e2e.released import RELEASE
from tests.helm import ensure_tools
from tests.helm.wayside_chart import Helm

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.e2e)
            item.add_marker(pytest.mark.xdist_group("node"))
            if (reason := why_no_node()) is not None:
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    running = getattr(item, "funcargs", {}).get("node")
    failed = isinstance(report, pytest.TestReport) and report.failed and call.when != "teardown"
    if failed and isinstance(running, Node):
        if namespace := getattr(item, "funcargs", {}).get("namespace"):
            report.sections.append(("pods of the test", pods_text(running, namespace)))
        report.sections.append(("logs of the node", running.tails(25)))
    return report


def pods_text(node: Node, namespace: str) -> str:
    """The state of the pods of a namespace, for messages."""
    kubectl = partial(node.plane.kubectl, "--namespace", namespace)
    reported = [kubectl("get", "pods,deployments", "-o", "wide"), kubectl("get", "events")]
    for pod in node.api(namespace).list("Pod"):
        with suppress(RuntimeError):  # a pod may have no container yet
            reported.append(f"--- {pod['metadata']['name']}\n{kubectl('logs', pod['metadata']['name'], '--tail=30')}")
    return "\n".join(reported)


@pytest.fixture(scope="session")
def node(request: pytest.FixtureRequest) -> Iterator[Node]:
    """A running cluster of one node with Wayside's CRDs, the same for all tests of the session."""
    capture = request.config.pluginmanager.getplugin("capturemanager")
    assert capture is not None
    with capture.global_and_fixture_disabled():  # the first build takes minutes: its progress is shown
        binaries, programs = ensure_binaries(), ensure_programs()
    with Node(binaries, programs, CRDS) as running:
        yield running


@pytest.fixture(scope="session")
def image(node: Node, request: pytest.FixtureRequest) -> str:
    """The name of the image built from the current tree, on the node."""
    capture = request.config.pluginmanager.getplugin("capturemanager")
    assert capture is not None
    with tempfile.TemporaryDirectory(prefix="wayside-image-") as folder:
        with capture.global_and_fixture_disabled():
            archive = wayside_archive(Path(folder))
        assert WAYSIDE_IMAGE in node.load(archive)
    return WAYSIDE_IMAGE


@pytest.fixture
def namespace(node: Node, request: pytest.FixtureRequest) -> Iterator[str]:
    """A fresh namespace that has its default service account; deleted afterwards without waiting."""
    with fresh_namespace(node.api(), request.node.name) as name:
        yield name


@pytest.fixture
def api(node: Node, namespace: str) -> Api:
    """An administrator's client whose default namespace is the test's."""
    return node.api(namespace)


@pytest.fixture
def helm(node: Node, namespace: str, tmp_path: Path) -> Iterator[Helm]:
    """Helm for the node; a release that the test leaves installed is uninstalled afterwards."""
    made = Helm(ensure_tools().helm, tmp_path / "home", node.plane.kubeconfig)
    yield made
    made("uninstall", RELEASE, "--namespace", namespace, "--ignore-not-found")
