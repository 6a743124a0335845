"""Runs the helm program, without access to the cluster, and without blocking the manager.

Each run has its own home folder, an environment without settings of a cluster or user, and limits: time, memory, file
size and output size. `helm template` does not contact the cluster. Only a pull has the proxies, certificates and
registry logins of the manager's environment.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import shutil
import signal
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from application_manager.core.objects.charts import ChartRequest, ChartSource
from wayside.api.applicationtemplate import OCI

PULL_TIME = 60.0  # s until a run is stopped
TEMPLATE_TIME = 20.0  # s; a chart takes a tenth of one
MEMORY = 1 << 30  # bytes of data
FILE_SIZE = 64 << 20  # bytes
OUTPUT = 8 << 20  # bytes, more than the API server would accept in many objects
_ERRORS = 1 << 14  # bytes

_OF_PULLS = (
    *("HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY", "http_proxy", "https_proxy", "no_proxy"),
    *("SSL_CERT_FILE", "SSL_CERT_DIR", "HELM_REGISTRY_CONFIG"),
)


class HelmError(Exception):
    """Helm failed; the text gives the reason. `slow`: it exceeded a time limit."""

    def __init__(self, message: str, *, slow: bool = False) -> None:
        super().__init__(message)
        self.slow = slow


@dataclass(frozen=True, slots=True)
class HelmRunner:
    """Runs helm.

    Attributes:
        program: a path, or a name on PATH.
        kube_version: the cluster's version, as charts see it in `.Capabilities`; None: Helm's default.
    """

    program: str = "helm"
    kube_version: str | None = None

    async def pull(self, source: ChartSource, folder: Path) -> Path:
        """Fetch the chart's archive into the folder, which is empty. Raises HelmError."""
        arguments = ["pull", source.chart, "--destination", str(folder)]
        arguments += ["--version", source.version] if source.version else []
        arguments += ["--repo", source.repository] if source.repository else []
        if source.chart.startswith(OCI) and _is_loopback(source.chart):
            arguments.append("--plain-http")  # as container tools do: traffic to this machine cannot be intercepted
        environment = {name: os.environ[name] for name in _OF_PULLS if name in os.environ}
        await self._run(arguments, PULL_TIME, environment)
        archives = [folder / name for name in os.listdir(folder) if name.endswith(".tgz")]
        if len(archives) != 1:
            raise HelmError(f"helm pull must return one archive; got {len(archives)}")
        return archives[0]

    async def template(self, request: ChartRequest, chart: Path) -> str:
        """Render the chart, an archive or a folder. Raises HelmError."""
        with _folder() as folder:
            values = folder / "values.json"
            values.write_text(request.values, encoding="utf-8")
            arguments = ["template", request.release, str(chart), "--namespace", request.namespace]
            arguments += ["--values", str(values), "--include-crds", "--skip-tests"]
            arguments += ["--kube-version", self.kube_version] if self.kube_version else []
            written = await self._run(arguments, TEMPLATE_TIME, {})
        try:
            return written.decode()
        except UnicodeDecodeError:
            raise HelmError("the output of helm template is not UTF-8 text") from None

    async def _run(self, arguments: list[str], seconds: float, more: Mapping[str, str]) -> bytes:
        program = shutil.which(self.program)
        if program is None:
            raise HelmError(
                f"cannot find the program {self.program!r}: install Helm 3.8 or newer on the PATH, or set --helm"
            )
        with _folder() as home:
            process = await asyncio.create_subprocess_exec(
                program,
                *arguments,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                cwd=home,
                env={**_environment(home), **more},
                start_new_session=True,  # so that all processes that it starts are stopped with it
            )
            _limit(process.pid, seconds)
            try:
                async with asyncio.timeout(seconds):
                    written, errors = await asyncio.gather(_read(process.stdout), _tail(process.stderr))
                    code = await process.wait()
            except TimeoutError:
                raise HelmError(
                    f"helm {arguments[0]} took more than {seconds:g} s and was stopped", slow=True
                ) from None
            finally:
                _kill(process.pid)
                await process.wait()
        if code != 0:
            output = errors.decode(errors="replace")
            raise HelmError(
                _cleaned(output) or f"helm {arguments[0]} exited with code {code}; it may have reached a resource limit"
            )
        return written


def _environment(home: Path) -> dict[str, str]:
    folders = {f"HELM_{kind}_HOME": str(home / kind.lower()) for kind in ("CACHE", "CONFIG", "DATA")}
    return {
        "HOME": str(home),
        "TMPDIR": str(home),
        "PATH": "/nonexistent",
        "KUBECONFIG": os.devnull,
        "HELM_PLUGINS": str(home / "plugins"),
        "GOMEMLIMIT": str(MEMORY * 3 // 4),
        **folders,
    }


def _limit(pid: int, seconds: float) -> None:
    limits = {
        resource.RLIMIT_CPU: int(seconds) + 5,
        resource.RLIMIT_FSIZE: FILE_SIZE,
        resource.RLIMIT_DATA: MEMORY,
        resource.RLIMIT_CORE: 0,
    }
    with contextlib.suppress(ProcessLookupError):
        for kind, limit in limits.items():
            resource.prlimit(pid, kind, (limit, limit))


async def _read(stream: asyncio.StreamReader | None) -> bytes:
    """The whole output. Raises HelmError if it is too large."""
    found = bytearray()
    while stream is not None and (part := await stream.read(1 << 16)):
        found += part
        if len(found) > OUTPUT:
            raise HelmError(f"the output of helm is larger than {OUTPUT >> 20} MiB: use a smaller chart")
    return bytes(found)


async def _tail(stream: asyncio.StreamReader | None) -> bytes:
    found = b""
    while stream is not None and (part := await stream.read(1 << 12)):
        found = (found + part)[-_ERRORS:]
    return found


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def _cleaned(output: str) -> str:
    """Helm's output on one line, without its own advice."""
    lines = [line.strip() for line in output.splitlines() if line.strip() and "--debug flag" not in line]
    return " ".join(line.removeprefix("Error: ") for line in lines if not line.startswith("level="))[-1500:]


def _is_loopback(chart: str) -> bool:
    host = urlsplit(chart).hostname or ""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="wayside-helm-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)
