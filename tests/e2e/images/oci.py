"""OCI archives, written byte for byte the same from the same content: sorted, without times, owned by root."""

from __future__ import annotations

import hashlib
import io
import json
import platform
import tarfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}
CHUNK = 1 << 20


@dataclass(frozen=True)
class Layer:
    """An uncompressed tar of files: it is only copied between disks."""

    path: Path
    digest: str
    size: int

    @classmethod
    def of(cls, path: Path) -> Layer:
        """Look at the file."""
        with path.open("rb") as file:
            return cls(path, f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}", path.stat().st_size)


@dataclass(frozen=True)
class Image:
    """The content and the metadata of an image.

    Attributes:
        name: with its tag.
        layers: from the lowest.
        config: as in an image's configuration: Entrypoint, Env, User, Labels …
    """

    name: str
    layers: Sequence[Layer]
    config: Mapping[str, Any] = field(default_factory=dict)


def write_layer(
    path: Path, sources: Iterable[tuple[Path, str]], skip: Callable[[str], bool] = lambda _: False
) -> Layer:
    """Write a layer of folders and files, each with its place in the image (`""`: the root).

    Args:
        path: the file to write; it appears when it is complete.
        sources: folders and files, and where each goes.
        skip: whether to leave out a path of the image (without a leading slash), and all below.
    """
    unfinished = path.with_suffix(".unfinished")
    with tarfile.open(unfinished, "w", format=tarfile.PAX_FORMAT) as tar:
        for source, place in sources:
            _add(tar, source, place.strip("/"), skip)
    unfinished.rename(path)
    return Layer.of(path)


def write_archive(path: Path, image: Image) -> None:
    """Write an OCI archive with one image, as `ctr images import` reads it; it appears when it is complete."""
    system = {"architecture": ARCHITECTURES.get(platform.machine(), platform.machine()), "os": "linux"}
    rootfs = {"type": "layers", "diff_ids": [layer.digest for layer in image.layers]}
    blobs: dict[str, bytes] = {}

    def blob(media: str, content: Any) -> dict[str, Any]:
        data = json.dumps(content, sort_keys=True).encode()
        digest = hashlib.sha256(data).hexdigest()
        blobs[digest] = data
        return {"mediaType": f"application/vnd.oci.image.{media}+json", "digest": f"sha256:{digest}", "size": len(data)}

    config = blob("config.v1", {**system, "config": dict(image.config), "rootfs": rootfs})
    layers = [
        {"mediaType": "application/vnd.oci.image.layer.v1.tar", "digest": layer.digest, "size": layer.size}
        for layer in image.layers
    ]
    version = {"schemaVersion": 2}
    media = "application/vnd.oci.image.manifest.v1+json"
    manifest = blob("manifest.v1", {**version, "mediaType": media, "config": config, "layers": layers})
    names = {"io.containerd.image.name": image.name, "org.opencontainers.image.ref.name": image.name.rpartition(":")[2]}
    index = {**version, "manifests": [{**manifest, "platform": system, "annotations": names}]}
    unfinished = path.with_suffix(".unfinished")
    with tarfile.open(unfinished, "w", format=tarfile.PAX_FORMAT) as tar:
        _add_bytes(tar, "oci-layout", json.dumps({"imageLayoutVersion": "1.0.0"}).encode())
        _add_bytes(tar, "index.json", json.dumps(index, sort_keys=True).encode())
        for digest, data in sorted(blobs.items()):
            _add_bytes(tar, f"blobs/sha256/{digest}", data)
        for layer in image.layers:
            with layer.path.open("rb") as file:
                info = _info(f"blobs/sha256/{layer.digest.removeprefix('sha256:')}")
                info.size = layer.size
                tar.addfile(info, file)
    unfinished.rename(path)


def _add(tar: tarfile.TarFile, source: Path, place: str, skip: Callable[[str], bool]) -> None:
    if place and skip(place):
        return
    if place:
        info = tar.gettarinfo(source, place)
        if info is None:  # a socket
            return
        info.uid = info.gid = 0
        info.uname = info.gname = ""
        info.mtime = 0
        if info.islnk():  # each hard link is stored with its content, so the order does not matter
            info.type, info.linkname, info.size = tarfile.REGTYPE, "", source.stat().st_size
        if info.isreg():
            with source.open("rb") as file:
                tar.addfile(info, file)
        else:
            tar.addfile(info)
    if source.is_dir() and not source.is_symlink():
        for child in sorted(source.iterdir()):
            _add(tar, child, f"{place}/{child.name}".strip("/"), skip)


def _info(name: str) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.mode = 0o644
    return info


def _add_bytes(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    info = _info(name)
    info.size = len(data)
    tar.addfile(info, io.BytesIO(data))
