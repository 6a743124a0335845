"""The given recordings, on disk or at URLs: how they are identified, and how a worker gets their files.

Recordings on disk are gathered as for a replay. At a URL, a recording is one file, or a rosbag2 folder.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from detector.replay.gathering import BINARY, TEXT, Recording, recording_name, recordings_of
from detector.replay.message import RecordingError
from detector.results.kinds import check_package

_BLOCK = 1 << 20
_BAG = "metadata.yaml"
_CHECKSUMS = ("ETag", "Content-MD5", "Digest", "Last-Modified", "mtime", "LastModified")
"""The properties by which stores distinguish versions of a file, the best first."""


class InputRecording(NamedTuple):
    """One recording."""

    name: str
    """Its name for users and in the dataset."""
    files: tuple[str, ...]
    """Paths, or URLs."""

    @property
    def is_remote(self) -> bool:
        """Whether its files must be fetched."""
        return "://" in self.files[0]


class RecordingPreview(NamedTuple):
    """The known properties of a recording before it is read."""

    content: str
    """Identifies the content: the same content gives the same text."""
    bytes: int


def sources_of(given: Iterable[str]) -> list[InputRecording]:
    """The recordings, in order of their names; each once.

    Args:
        given: files, folders and patterns, on disk or as URLs; @FILE for a file with one of these per line.

    Raises:
        RecordingError: one is missing; a folder, pattern or list contains no recording.
        MissingExtraError: a URL needs a package that is not installed.
        OSError: a list or a folder cannot be read.
    """
    items = [item for each in given for item in _listed(each)]
    local = [Path(item) for item in items if "://" not in item]
    found = [_on_disk(recording) for recording in recordings_of(local)] if local else []
    for item in items:
        if "://" in item:
            found += _behind(item)
    return sorted({source.files: source for source in found}.values())


def preview(source: InputRecording) -> RecordingPreview:
    """Identify the recording: by its content on disk, by the store's properties at a URL.

    Raises:
        OSError: a file cannot be read.
    """
    whole = hashlib.blake2b(digest_size=16)
    size = 0
    for file in source.files:
        digest, length = _stored(file) if source.is_remote else _read(Path(file))
        whole.update(digest)
        size += length
    return RecordingPreview(whole.hexdigest(), size)


def stamp_of(source: InputRecording) -> str | None:
    """Changes if the files on disk do: size and modification time of each; None for URLs, which are checked quickly."""
    if source.is_remote:
        return None
    stats = [path.stat() for file in source.files for path in _files(Path(file))]
    return " ".join(f"{each.st_size}:{each.st_mtime_ns}" for each in stats)


@contextmanager
def fetched(source: InputRecording) -> Iterator[Recording]:
    """The recording's files on disk; those from URLs exist during the context.

    Raises:
        OSError: a file cannot be fetched.
    """
    if not source.is_remote:
        yield tuple(map(Path, source.files))
        return
    with tempfile.TemporaryDirectory(prefix="wayside-mine-") as folder:
        yield tuple(_fetch(url, Path(folder) / str(number)) for number, url in enumerate(source.files))


def _listed(item: str) -> list[str]:
    if not item.startswith("@"):
        return [item]
    lines = Path(item[1:]).read_text(encoding="utf-8").splitlines()
    items = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not items:
        raise RecordingError(f"{item[1:]}: the list is empty: write one recording on each line")
    return items


def _on_disk(recording: Recording) -> InputRecording:
    return InputRecording(recording_name(recording), tuple(str(path.absolute()) for path in recording))


def _files(path: Path) -> Iterator[Path]:
    yield from sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else (path,)


def _read(path: Path) -> tuple[bytes, int]:
    """A digest of the content, and its size in bytes. The suffix is included, because it determines the reader."""
    digest, size = hashlib.blake2b(path.suffix.encode(), digest_size=16), 0
    for each in _files(path):
        digest.update(each.name.encode() if path.is_dir() else b"")
        with each.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
                size += len(block)
    return digest.digest(), size


# URLs


def _store(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    check_package("fsspec", url, "mining")
    scheme = urlsplit(url).scheme
    if scheme == "s3":  # pyarrow's own: the packages of s3fs exclude those of the Kubernetes client
        check_package("pyarrow", url, "mining")
        from fsspec.implementations.arrow import ArrowFSWrapper  # noqa: PLC0415  an extra
        from pyarrow.fs import S3FileSystem  # noqa: PLC0415

        return ArrowFSWrapper(S3FileSystem(**_s3_options())), url.removeprefix("s3://")
    from fsspec import url_to_fs  # noqa: PLC0415

    try:
        store, path = url_to_fs(url)
    except (ValueError, ImportError) as error:
        raise RecordingError(f"{url}: {error}: give s3://, https:// or http://") from error
    return store, path


def _s3_options() -> dict[str, str]:
    """The location of S3, from the variables of the AWS command line tools; the library finds credentials."""
    options = {}
    if endpoint := os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL"):
        options["endpoint_override"] = endpoint
    if region := os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION"):
        options["region"] = region
    return options


def _behind(url: str) -> Iterator[InputRecording]:
    """The recordings at a URL."""
    store, path = _store(url)
    is_file = PurePosixPath(path).suffix in (*BINARY, *TEXT)
    try:
        is_pattern = any(sign in path for sign in "*[")
        paths = store.glob(path) if is_pattern else [path] if is_file else store.find(path)
    except OSError as error:
        raise RecordingError(f"{url}: cannot list it: {error}") from error
    bags = {str(PurePosixPath(each).parent) for each in paths if PurePosixPath(each).name == _BAG}
    files = [each for each in paths if PurePosixPath(each).suffix in (*BINARY, *TEXT)]
    found = [*bags, *(each for each in files if str(PurePosixPath(each).parent) not in bags)]
    if not found:
        raise RecordingError(f"{url}: contains no recording: give one with {', '.join((*BINARY, *TEXT))}")
    prefix = "s3://" if url.startswith("s3://") else ""
    for each in found:
        whole = each if "://" in each else prefix + each
        yield InputRecording(whole, (whole,))


def _members(store: Any, path: str) -> list[str]:
    """The files of a recording."""
    return [path] if PurePosixPath(path).suffix in (*BINARY, *TEXT) else sorted(store.find(path))


def _stored(url: str) -> tuple[bytes, int]:
    """A digest of the store's properties of the content, and its size; if these are insufficient, of the content."""
    store, path = _store(url)
    digest, size = hashlib.blake2b(url.encode(), digest_size=16), 0
    for each in _members(store, path):
        info = store.info(each)
        length, checksum = info.get("size"), next((info[name] for name in _CHECKSUMS if info.get(name)), None)
        if length is None or checksum is None:
            with tempfile.TemporaryDirectory(prefix="wayside-mine-") as folder:
                file = Path(folder) / "file"
                store.get_file(each, str(file))
                content, length = _read(file)
                checksum = content.hex()
        digest.update(f"{each}\0{length}\0{checksum}\0".encode())
        size += length
    return digest.digest(), size


def _fetch(url: str, folder: Path) -> Path:
    """Fetch a file or folder; returns its path."""
    store, path = _store(url)
    members = _members(store, path)
    folder = folder / PurePosixPath(path).name if members != [path] else folder
    folder.mkdir(parents=True)
    for each in members:
        store.get_file(each, str(folder / PurePosixPath(each).name))
    return folder / PurePosixPath(path).name if members == [path] else folder


def sampled(sources: Sequence[InputRecording], number: int) -> list[InputRecording]:
    """A sample of the recordings, in their order: selected by a digest of their names, so always the same."""
    by_chance = sorted(sources, key=lambda source: hashlib.blake2b(source.name.encode(), digest_size=8).digest())
    return sorted(by_chance[:number])
