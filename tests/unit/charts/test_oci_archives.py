"""The tests' own images: the same content gives the same bytes, and the archive describes its contents."""

from __future__ import annotations

import hashlib
import json
import os
import tarfile
from pathlib import Path

from tests.e2e.images.oci import Image, write_archive, write_layer


def written(folder: Path, time: int, order: list[str]) -> Path:
    root = folder / "root"
    root.mkdir(parents=True)
    for name in order:
        (root / name).write_text(name)
        os.utime(root / name, (time, time))
    (root / "link").symlink_to("a")
    layer = write_layer(folder / "layer.tar", [(root, "opt/app")], lambda place: place.endswith("/left-out"))
    write_archive(archive := folder / "image.tar", Image("example.test/app:1", [layer], {"User": "65532"}))
    return archive


def test_the_same_content_gives_the_same_bytes_whenever_it_was_written(tmp_path: Path) -> None:
    first = written(tmp_path / "first", 1_000_000_000, ["a", "b", "left-out"])
    second = written(tmp_path / "second", 1_700_000_000, ["left-out", "b", "a"])
    assert first.read_bytes() == second.read_bytes()


def test_the_archive_leads_from_its_index_to_the_files(tmp_path: Path) -> None:
    with tarfile.open(written(tmp_path, 0, ["a", "left-out"])) as archive:

        def blob(descriptor: dict[str, str]) -> bytes:
            file = archive.extractfile(f"blobs/sha256/{descriptor['digest'].removeprefix('sha256:')}")
            assert file is not None
            data = file.read()
            assert f"sha256:{hashlib.sha256(data).hexdigest()}" == descriptor["digest"]
            return data

        index = archive.extractfile("index.json")
        assert index is not None
        (entry,) = json.load(index)["manifests"]
        assert entry["annotations"]["io.containerd.image.name"] == "example.test/app:1"
        manifest = json.loads(blob(entry))
        config = json.loads(blob(manifest["config"]))
        assert config["config"] == {"User": "65532"}
        (layer,) = manifest["layers"]
        assert config["rootfs"]["diff_ids"] == [layer["digest"]]
        (tmp_path / "found.tar").write_bytes(blob(layer))
    with tarfile.open(tmp_path / "found.tar") as found:
        assert {each.name for each in found} == {"opt/app", "opt/app/a", "opt/app/link"}
