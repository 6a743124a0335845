"""Whether the packages of an extra are installed."""

from __future__ import annotations

from importlib.util import find_spec

from wayside.inputerror import InputError


class MissingExtraError(InputError, RuntimeError):
    """A result needs a package that is not installed."""


def check_package(package: str, option: str, extra: str = "results") -> None:
    """Raises MissingExtraError if the package that the option needs is missing."""
    if find_spec(package) is None:
        raise MissingExtraError(f"{option} needs {package}: pip install 'wayside[{extra}]'")
