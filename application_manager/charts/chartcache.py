"""The cache of charts on disk: each archive once, by its digest, and the digest of each source.

    <folder>/charts/<sha256>.tgz        an archive
    <folder>/sources/<sha256>           a source, by its hash → the digest of its archive

A version of a chart is assumed not to change, so a known source is not fetched again, even after a restart. An archive
whose content does not match its name is fetched again. The least recently used archives are deleted first.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from application_manager.charts.helm import HelmError, HelmRunner
from application_manager.core.objects.charts import ChartSource

KEPT = 64  # archives


@dataclass(frozen=True, slots=True)
class ChartCache:
    """Provides charts as paths.

    `folder`: the cache, created if it is missing. `local`: the folder with the charts of the image; a template may only
    name paths in it.
    """

    helm: HelmRunner
    folder: Path
    local: Path

    async def path(self, source: ChartSource) -> Path:
        """The path of the chart, which is fetched if it is not cached. Raises HelmError."""
        if source.chart.startswith("/"):
            return await asyncio.to_thread(self._local, source.chart)
        try:
            known = await asyncio.to_thread(self._known, source)
            return known if known is not None else await self._fetched(source)
        except OSError as error:
            raise HelmError(
                f"cannot write charts to {self.folder}: {error.strerror or error}: start the manager with "
                "--chart-cache and a writable folder"
            ) from None

    def _local(self, chart: str) -> Path:
        path = Path(chart).resolve()
        if not path.is_relative_to(self.local.resolve()):
            raise HelmError(
                f"chart {chart} is not in {self.local}, the manager's --chart-folder: put it there, or start the "
                "manager with another --chart-folder"
            )
        if not path.exists():
            raise HelmError(f"chart {chart} does not exist in the manager's image: put it there, or correct the path")
        return path

    def _known(self, source: ChartSource) -> Path | None:
        try:
            digest = self._index(source).read_text()
            archive = self._archive(digest)
            if _digest(archive) != digest:
                return None
            os.utime(archive)
        except FileNotFoundError:
            return None
        return archive

    async def _fetched(self, source: ChartSource) -> Path:
        await asyncio.to_thread(self._prepare)
        with tempfile.TemporaryDirectory(prefix=".", dir=self.folder) as place:
            archive = await self.helm.pull(source, Path(place))
            return await asyncio.to_thread(self._keep, source, archive)

    def _prepare(self) -> None:
        for name in ("charts", "sources"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)

    def _keep(self, source: ChartSource, archive: Path) -> Path:
        digest = _digest(archive)
        kept = self._archive(digest)
        archive.replace(kept)
        index = archive.parent / "index"
        index.write_text(digest)
        index.replace(self._index(source))
        for old in sorted(kept.parent.iterdir(), key=lambda each: each.stat().st_mtime)[:-KEPT]:
            old.unlink(missing_ok=True)
        return kept

    def _archive(self, digest: str) -> Path:
        return self.folder / "charts" / f"{digest}.tgz"

    def _index(self, source: ChartSource) -> Path:
        named = "\0".join((source.chart, source.version or "", source.repository or ""))
        return self.folder / "sources" / hashlib.sha256(named.encode()).hexdigest()


def default_folder() -> Path:
    """The default folder of cached charts."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wayside" / "charts"


def _digest(archive: Path) -> str:
    with archive.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
