"""The fixtures of the cluster tests: one control plane for all workers of a run, one namespace for each test.

Every test in this folder has the marker `cluster`. Those with the marker `own_control_plane` run on a control plane of
their own, one after the other on one worker. The report of a failed test includes the ends of the logs of its
processes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.api import Api
from tests.cluster.chain import Chain, Vehicles, detector, rule, template
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.cluster.expected_objects import start_manager
from tests.cluster.namespaces import new_namespace
from tests.cluster.pods import kubelet as playing_kubelet
from tests.cluster.processes import Process, Processes, environment_of
from tests.sharing import run_folder, shared

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.cluster)
            if item.get_closest_marker("own_control_plane") is not None:
                item.add_marker(pytest.mark.xdist_group(item.path.stem))


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
def shared_control_plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlPlane]:
    """A running control plane with Wayside's CRDs, shared by all tests of the run that have no other marker."""
    folder = run_folder(tmp_path_factory)
    with shared(folder, "control-plane", lambda: ControlPlane(crds=CRDS, logs=folder / "control-plane")) as running:
        yield running


@pytest.fixture(scope="module")
def own_control_plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlPlane]:
    """A control plane for the marked tests of a module: they stop it, or affect every namespace."""
    with ControlPlane(crds=CRDS, logs=tmp_path_factory.mktemp("control-plane")) as running:
        yield running


@pytest.fixture
def control_plane(request: pytest.FixtureRequest) -> ControlPlane:
    """The control plane of the test: the shared one or, with the marker, one of its own."""
    own = request.node.get_closest_marker("own_control_plane") is not None
    plane = request.getfixturevalue("own_control_plane" if own else "shared_control_plane")
    assert isinstance(plane, ControlPlane)
    if own:
        plane.recover()  # the previous test may have left programs stopped
    return plane


@pytest.fixture
def namespace(control_plane: ControlPlane, request: pytest.FixtureRequest) -> str:
    """A fresh namespace that has its default service account.

    It is not deleted before the control plane ends. Deleting hundreds of namespaces would keep the controllers busy for
    minutes and delay the tests that wait for the garbage collector.
    """
    return new_namespace(control_plane.api(), request.node.name)


@pytest.fixture
def api(control_plane: ControlPlane, namespace: str) -> Api:
    """An administrator's client whose default namespace is the test's."""
    return control_plane.api(namespace)


@pytest.fixture
def processes(control_plane: ControlPlane, namespace: str, tmp_path: Path) -> Iterator[Processes]:
    """Starts Wayside's programs with the kubeconfig of the control plane and kills them after the test."""
    folder = tmp_path / "logs"
    folder.mkdir()
    started = Processes(folder, environment_of(control_plane.kubeconfig))
    yield started
    started.kill_all()


@pytest.fixture
def manager(processes: Processes, namespace: str) -> Process:
    """A manager of the test's namespace."""
    return start_manager(processes, namespace)


@pytest.fixture
def chain(api: Api, namespace: str, processes: Processes, tmp_path: Path) -> Chain:
    """A Detector with its rule and template, applied; neither program is started yet."""
    made = Chain(api, namespace, processes, tmp_path / "out")
    made.apply(template(), rule(), detector(made.endpoint))
    return made


@pytest.fixture
def vehicles(chain: Chain) -> Iterator[Vehicles]:
    with Vehicles(chain.endpoint) as driving:
        yield driving


@pytest.fixture
def kubelet(api: Api) -> Iterator[None]:
    """Every pod of the test's namespace becomes ready by itself, soon after its creation."""
    with playing_kubelet(api):
        yield
