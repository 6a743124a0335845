"""Whether this machine can run a node: root is not enough, for instance in an unprivileged container."""

from __future__ import annotations

import os
import subprocess
from functools import cache

from tests.e2e.node.enclosure import cgroup_roots

_TRY = "mount -t tmpfs tmpfs /mnt && ip link add wayside-a type veth peer name wayside-b"
_NAMESPACES = ("--mount", "--net", "--pid", "--propagation=private", "--fork", "--kill-child")


@cache
def why_no_node() -> str | None:
    """The reason why no node can run here, with the remedy; None if one can."""
    if os.geteuid() != 0:
        return "a real node needs root: run `make e2e` as root"
    try:
        done = subprocess.run(["unshare", *_NAMESPACES, "sh", "-c", _TRY], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        return f"a real node needs {error.filename}: install util-linux"
    if done.returncode:
        logged = " ".join(done.stderr.split())
        return f"a real node needs namespaces, mounts and interfaces: run this in a privileged container: {logged}"
    for root in cgroup_roots():
        tried = root / f"wayside-try-{os.getpid()}"
        try:
            tried.mkdir()
            tried.rmdir()
        except OSError as error:
            return f"a real node needs cgroups of its own: run this in a privileged container: {error}"
    return None
