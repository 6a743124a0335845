"""Run a control plane with Wayside's CRDs until Ctrl-C or SIGTERM; print how to use it."""

from __future__ import annotations

import signal
import sys
import threading

from tests.cluster.binaries import BinariesUnavailableError
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS


def main() -> int:
    """Run it; the last line on stdout once it is ready is `export KUBECONFIG=…`."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    try:
        with ControlPlane(crds=CRDS) as control_plane:
            for file, error in control_plane.refused_crds.items():
                print(f"{file} is refused: {error}", file=sys.stderr)
            print(f"# {control_plane.url}, logs in {control_plane.folder}; kubectl: {control_plane.binaries.kubectl}")
            print(f"export KUBECONFIG={control_plane.kubeconfig}", flush=True)
            ended.wait()
    except BinariesUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
