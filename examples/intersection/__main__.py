"""Write the recording: `python -m examples.intersection drive.jsonl`."""

from __future__ import annotations

import sys
from pathlib import Path

from examples.intersection.generator import recording

if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m examples.intersection FILE.jsonl")
    Path(sys.argv[1]).write_text(recording(), encoding="utf-8")
