"""The modules that a fork server of `tests.programs` imports before it forks: those of both programs."""

from __future__ import annotations

import pkgutil
from importlib import import_module

import tests.programs

for package in ("wayside", "detector", "application_manager"):
    for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
        if not module.name.endswith(".__main__"):
            import_module(module.name)

assert tests.programs  # forked processes inherit the imports
