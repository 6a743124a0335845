"""Hooks for all tests."""

from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, Phase, settings

from tests.failures import shorten
from tests.sharing import run_folder

# The duration of an example depends more on the machine's load than on the code, and how many of the first
# ones are too large or left out is a matter of luck; where no example is left, that is an error all the same.
settings.register_profile(
    "wayside",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
)
# Only whether a test fails: hypothesis does not look for the smallest example.
settings.register_profile(
    "unshrunk",
    settings.get_profile("wayside"),
    phases=[Phase.explicit, Phase.generate],
    report_multiple_bugs=False,
)
settings.load_profile("wayside")


@pytest.hookimpl(wrapper=True, tryfirst=True)  # the outermost: it sees what the folders' own hooks add
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    if isinstance(report, pytest.TestReport) and report.failed:
        shorten(report, run_folder(item.config._tmp_path_factory) / "failures")
    return report


@pytest.hookimpl(trylast=True)  # once the folders' own hooks have made the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that stay on one worker come first: begun last, the others would wait for them."""
    items.sort(key=lambda item: item.get_closest_marker("xdist_group") is None)
