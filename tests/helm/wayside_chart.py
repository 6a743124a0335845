"""The project's own chart, rendered and installed by a real helm."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

CHART = Path(__file__).parents[2] / "charts" / "wayside"
Values = dict[str, Any]


class HelmError(Exception):
    """Helm failed; the text is its message."""


@dataclass(frozen=True)
class Helm:
    """A helm program with a home of its own, for the cluster of a kubeconfig, or for none."""

    program: Path
    home: Path
    kubeconfig: Path | None = None

    def __call__(self, *arguments: str, values: Values | None = None) -> str:
        """Run helm; what it prints. Raises HelmError."""
        self.home.mkdir(exist_ok=True)
        environment = {"HOME": str(self.home), "PATH": os.environ["PATH"]}
        if self.kubeconfig is not None:
            environment["KUBECONFIG"] = str(self.kubeconfig)
        given: list[str] = []
        if values is not None:
            given = ["--values", "-"]
        done = subprocess.run(
            [str(self.program), *arguments, *given],
            env=environment,
            input=json.dumps(values or {}),
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise HelmError(done.stderr)
        return done.stdout

    def rendered(
        self, values: Values | None = None, *options: str, name: str = "wayside", namespace: str = "town"
    ) -> Rendered:
        """The rendered chart with the values."""
        text = self("template", name, str(CHART), "--namespace", namespace, *options, values=values or {})
        return Rendered([each for each in yaml.safe_load_all(text) if each])


@dataclass(frozen=True)
class Rendered:
    """The manifests of a release."""

    manifests: list[dict[str, Any]] = field(default_factory=list)

    def of(self, *kinds: str) -> list[dict[str, Any]]:
        """Those of the kinds, in their order."""
        return [each for each in self.manifests if each["kind"] in kinds]

    def one(self, kind: str, name: str = "") -> dict[str, Any]:
        """The only one of the kind, or of that and the name."""
        (found,) = (each for each in self.of(kind) if name in ("", each["metadata"]["name"]))
        return found

    def pods(self) -> Iterator[dict[str, Any]]:
        """The spec of each pod."""
        for each in self.manifests:
            if each["kind"] == "Pod":
                yield each["spec"]
            elif each["kind"] in ("Deployment", "StatefulSet", "DaemonSet", "Job"):
                yield each["spec"]["template"]["spec"]


def names(manifests: Sequence[dict[str, Any]]) -> set[tuple[str, str]]:
    """Kind and name of each."""
    return {(each["kind"], each["metadata"]["name"]) for each in manifests}
