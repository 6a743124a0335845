"""The fixtures of the cluster tests: one control plane a session, one namespace a test.

Every test in this folder has the marker `cluster`. When one fails, the ends of the logs of its processes are part of
the report.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.api import Api
from tests.cluster.binaries import ensure_binaries
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.cluster.namespaces import fresh_namespace
from tests.cluster.pods import kubelet as playing_kubelet
from tests.cluster.processes import Processes

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.cluster)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Iterator[None]:  # the value sent in is the report
    report = yield
    if isinstance(report, pytest.TestReport) and report.failed:
        funcargs = getattr(item, "funcargs", {})
        if isinstance(processes := funcargs.get("processes"), Processes) and (tails := processes.tails()):
            report.sections.append(("logs of the test's processes", tails))
        if isinstance(plane := funcargs.get("control_plane"), ControlPlane) and call.when != "teardown":
            report.sections.append(("logs of the control plane", plane.tails(15)))
    return report


@pytest.fixture(scope="session")
def control_plane(request: pytest.FixtureRequest) -> Iterator[ControlPlane]:
    """A running control plane with Wayside's CRDs, the same for all tests of the session."""
    capture = request.config.pluginmanager.getplugin("capturemanager")
    if capture is None:
        binaries = ensure_binaries()
    else:
        with capture.global_and_fixture_disabled():  # the first build takes minutes, which nobody should wait blindly
            binaries = ensure_binaries()
    with ControlPlane(binaries, CRDS) as running:
        yield running


@pytest.fixture
def namespace(control_plane: ControlPlane, request: pytest.FixtureRequest) -> Iterator[str]:
    """A fresh namespace that has its default service account; deleted afterwards without waiting."""
    control_plane.recover()
    with fresh_namespace(control_plane.api(), request.node.name) as name:
        yield name


@pytest.fixture
def api(control_plane: ControlPlane, namespace: str) -> Api:
    """An administrator's client whose default namespace is the test's."""
    return control_plane.api(namespace)


@pytest.fixture
def processes(control_plane: ControlPlane, namespace: str, tmp_path: Path) -> Iterator[Processes]:
    """Starts Wayside's programs with the kubeconfig of the control plane; none outlives the test."""
    folder = tmp_path / "logs"
    folder.mkdir()
    started = Processes(folder, {"KUBECONFIG": str(control_plane.kubeconfig)})
    yield started
    started.kill_all()


@pytest.fixture
def kubelet(api: Api) -> Iterator[None]:
    """Every pod of the test's namespace becomes ready by itself, soon after it was made."""
    with playing_kubelet(api):
        yield
