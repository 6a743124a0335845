"""`python -m wayside.api [FOLDER]`: write the CRDs, one file a kind, into FOLDER (default: crds)."""

from __future__ import annotations

import sys
from pathlib import Path

from wayside.api import GROUP, KINDS
from wayside.api.schema import crd
from wayside.manifests import to_yaml


def crd_files() -> dict[str, str]:
    """The CRDs' YAML by file name."""
    return {f"{GROUP}_{kind.plural}.yaml": to_yaml([crd(kind)]) for kind in KINDS.values()}


def main() -> None:
    """Write the files."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "crds")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in crd_files().items():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
