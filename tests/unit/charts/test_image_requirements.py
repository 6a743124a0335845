"""The image's packages are pinned with hashes and cover all dependencies of the programs."""

from __future__ import annotations

import re
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.guides import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
EXTRAS = ("etsi", "mqtt", "otel")
FULL = (*EXTRAS, "onnx", "protobuf", "results")


def pins(file: str) -> dict[str, tuple[Version, str]]:
    """Version and lines of each package of a file in docker/."""
    return {
        canonicalize_name(name): (Version(version), block)
        for block in re.split(r"\n(?=\S)", (ROOT / "docker" / file).read_text())
        for name, version in re.findall(r"^([\w.-]+)==([^\s;\\]+)", block)
    }


PINS = {"requirements.txt": pins("requirements.txt"), "requirements-full.txt": pins("requirements-full.txt")}


@pytest.mark.parametrize(("file", "extras"), [("requirements.txt", EXTRAS), ("requirements-full.txt", FULL)])
def test_the_image_has_the_dependencies_of_the_programs(file: str, extras: tuple[str, ...]) -> None:
    requested = [
        *PROJECT["dependencies"],
        *(each for extra in extras for each in PROJECT["optional-dependencies"][extra]),
    ]
    for requirement in map(Requirement, requested):
        name = canonicalize_name(requirement.name)
        assert name in PINS[file], "run `make requirements`"
        assert requirement.specifier.contains(PINS[file][name][0]), "run `make requirements`"


def test_every_package_is_pinned_by_hash_and_the_full_image_includes_the_slim_one() -> None:
    small, full = PINS.values()
    for each in (small, full):
        assert [name for name, (_, block) in each.items() if "--hash=sha256:" not in block] == []
    assert {name: version for name, (version, _) in small.items()}.items() <= {
        name: version for name, (version, _) in full.items()
    }.items()


def test_the_base_is_pinned_by_its_digest_and_the_user_is_not_root() -> None:
    assert re.search(r"^ARG BASE=\S+@sha256:[0-9a-f]{64}$", DOCKERFILE, re.MULTILINE)
    assert re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE) == ["${BASE}", "${BASE}"]
    assert re.search(r"^USER 65532:65532$", DOCKERFILE, re.MULTILINE)


def test_copied_paths_of_the_dockerfile_exist_and_are_not_ignored() -> None:
    let_through = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {
        name for line in re.findall(r"^COPY (?!--from)(.*) \S+$", DOCKERFILE, re.MULTILINE) for name in line.split()
    }
    assert copied == let_through
    assert all((ROOT / name).exists() for name in copied)
