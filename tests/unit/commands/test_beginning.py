"""The start: imported objects are not garbage-collected, and a command imports only what it needs."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest

from tests.guides import ROOT
from tests.patience import PATIENCE
from wayside.process.startup import importing

EXAMPLE = ROOT / "examples" / "cooperative-recording"
FILES = [str(EXAMPLE / name) for name in ("detector.yaml", "rules.yaml", "templates.yaml")]
RENDERED = [f"--templates={EXAMPLE}/templates.yaml", f"--tasks={EXAMPLE}/templates.yaml"]

LOADED = """
import sys
from {package}.program import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print()
print(*sys.modules)
"""
"""Runs a command, and lists the modules that are loaded at its end in the last line."""

NETWORK = {"aiohttp", "kopf", "kubernetes", "requests", "zenoh"}
RECORDINGS = {"apsw", "lz4", "mcap", "zstandard"}
ACTIONS_AND_STREAMS = {"asn1tools", "cryptography", "onnxruntime", "pycrate_asn1dir", "pymongo", "sqlite3"}
OBSERVING = {"opentelemetry", "prometheus_client", "rich"}
HEAVY = NETWORK | RECORDINGS | ACTIONS_AND_STREAMS | OBSERVING | {"scipy"}
EVALUATING = {"asyncio", "cel_expr_python", "msgspec", "numpy", "pydantic", "rosbags", "yaml"}


def test_garbage_collection_pauses_during_imports_and_skips_imported_objects() -> None:
    try:
        with importing():
            assert not gc.isenabled()
            imported = [[number] for number in range(10)]
        assert gc.isenabled()
        assert not {id(each) for each in imported} & {id(each) for each in gc.get_objects()}
    finally:
        gc.unfreeze()


def loaded(code: str, *words: str) -> set[str]:
    """The packages that a program has loaded at its end."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    return {name.partition(".")[0] for name in done.stdout.splitlines()[-1].split()}


@pytest.mark.parametrize("package", ["detector.commands", "application_manager"])
@pytest.mark.parametrize("words", [["--help"], ["run", "--help"]], ids=" ".join)
def test_help_loads_no_package_of_running_commands(package: str, words: list[str]) -> None:
    of_typer = {"pydantic", "rich"}  # it lays out the help and checks options with them
    assert loaded(LOADED.format(package=package), *words) & (HEAVY | EVALUATING) <= of_typer


@pytest.mark.parametrize(
    ("package", "words", "needs_not"),
    [
        pytest.param("detector.commands", ["check", *FILES], HEAVY | {"asyncio"}, id="detector check"),
        pytest.param(
            "application_manager",
            ["check", *FILES],
            HEAVY | {"asyncio", "msgspec", "numpy", "rosbags"},
            id="application-manager check",
        ),
        pytest.param(
            "application_manager",
            ["render", *RENDERED],
            HEAVY | {"msgspec", "numpy", "rosbags"},
            id="application-manager render",
        ),
    ],
)
def test_a_command_on_files_loads_neither_zenoh_nor_recording_libraries(
    package: str, words: list[str], needs_not: set[str]
) -> None:
    assert not loaded(LOADED.format(package=package), *words) & needs_not


def test_a_detector_loads_only_the_packages_of_its_settings_and_options() -> None:
    code = "import sys, detector.live.service; print(*sys.modules)"
    assert loaded(code) & HEAVY == {"zenoh"}
