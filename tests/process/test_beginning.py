"""Both programs can be ended before they have imported what they need."""

from __future__ import annotations

import subprocess
import sys

import pytest

from wayside.process.startup import ENDED

WHILE_IT_IMPORTS = """
import os, signal, sys, threading
import {package}.program as program

class Cli:
    def find_spec(self, name, path=None, target=None):
        if name == "{package}.cli":
            print(sorted(set(sys.modules) & {{"typer", "pydantic", "kubernetes", "zenoh", "kopf"}}), flush=True)
            os.kill(os.getpid(), signal.SIGTERM)
            threading.Event().wait()

sys.meta_path.insert(0, Cli())
program.main()
"""
"""The import of all the rest never ends; before it, a signal comes. That would be spared the first process of a
container, or else end it by the signal itself."""


@pytest.mark.parametrize("package", ["detector.commands", "application_manager"])
def test_a_program_stopped_during_its_imports_ends(package: str) -> None:
    code = WHILE_IT_IMPORTS.format(package=package)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (ENDED, "[]\n")
