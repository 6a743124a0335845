"""Charts for tests, and real servers for them: a repository over HTTP and an OCI registry."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from tests.helm import Tools
from tests.networks import wait_for
from tests.ports import free_port

DEPLOYMENT = """\
apiVersion: apps/v1
kind: Deployment
metadata:
  name: {{ .Release.Name }}
  namespace: {{ .Release.Namespace }}
spec:
  replicas: {{ .Values.replicas }}
  selector: {matchLabels: {app: {{ .Release.Name }}}}
  template:
    metadata:
      labels: {app: {{ .Release.Name }}}
    spec:
      containers:
        - name: main
          image: {{ .Values.image }}
"""
CONFIG = """\
{{- if .Values.sources }}
apiVersion: v1
kind: ConfigMap
metadata: {name: {{ .Release.Name }}-sources}
data: {sources: {{ join "," .Values.sources | quote }}, since: "2026-01-02"}
{{- end }}
"""
HOOK = """\
apiVersion: batch/v1
kind: Job
metadata:
  name: {{ .Release.Name }}-migrate
  annotations: {"helm.sh/hook": pre-install}
spec: {template: {spec: {restartPolicy: Never, containers: [{name: main, image: x}]}}}
"""
TEST_HOOK = HOOK.replace("pre-install", "test").replace("migrate", "try")
CRD = """\
apiVersion: apiextensions.k8s.io/v1
kind: CustomResourceDefinition
metadata: {name: things.example.com}
spec: {group: example.com}
"""
RANDOM = """\
apiVersion: v1
kind: ConfigMap
metadata: {name: {{ .Release.Name }}-random}
data: {password: {{ randAlphaNum 20 }}}
"""
VALUES = "replicas: 1\nimage: app:1\nsources: []\n"
APPLICATION = {
    "values.yaml": VALUES,
    "templates/deployment.yaml": DEPLOYMENT,
    "templates/sources.yaml": CONFIG,
    "templates/tests/try.yaml": TEST_HOOK,
}


def write_chart(folder: Path, name: str, files: Mapping[str, str] = APPLICATION, version: str = "1.0.0") -> Path:
    """Write a chart as a folder and return its path."""
    chart = folder / name
    every = {"Chart.yaml": f"apiVersion: v2\nname: {name}\nversion: {version}\n", **files}
    for path, text in every.items():
        (chart / path).parent.mkdir(parents=True, exist_ok=True)
        (chart / path).write_text(text)
    return chart


def helm(tools: Tools, home: Path, *arguments: str) -> str:
    """Run helm for the test itself."""
    home.mkdir(exist_ok=True)
    environment = {"HOME": str(home), "PATH": os.environ["PATH"]}
    done = subprocess.run([str(tools.helm), *arguments], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@contextmanager
def repository(tools: Tools, folder: Path, *charts: Path) -> Iterator[tuple[str, list[str]]]:
    """A chart repository over HTTP with these charts; its URL, and the requests so far."""
    folder.mkdir()
    for chart in charts:
        helm(tools, folder.parent / "home", "package", str(chart), "--destination", str(folder))
    helm(tools, folder.parent / "home", "repo", "index", str(folder))
    requested: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            requested.append(self.path)

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", requested
        finally:
            server.shutdown()


@contextmanager
def registry(tools: Tools, folder: Path, *charts: Path) -> Iterator[str]:
    """An OCI registry with these charts; what their names begin with."""
    folder.mkdir()
    port = free_port()
    command = [str(tools.registry), "-port", str(port)]
    with (
        (folder / "log").open("wb") as log,
        subprocess.Popen(command, stdout=log, stderr=log) as process,
    ):
        try:
            where = f"oci://127.0.0.1:{port}/charts"
            wait_for(lambda: _listens(port))
            for chart in charts:
                helm(tools, folder.parent / "home", "package", str(chart), "--destination", str(folder))
            for archive in folder.glob("*.tgz"):
                helm(tools, folder.parent / "home", "push", str(archive), where, "--plain-http")
            yield where
        finally:
            process.kill()


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        time.sleep(0.01)
        return False
    return True


@contextmanager
def silence() -> Iterator[str]:
    """A repository that accepts connections and never answers; its URL."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
