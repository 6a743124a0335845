"""Simulates the kubelet: there are no nodes here, so tests set the statuses of pods.

`mark_pods_ready` does it once, `kubelet` does it continuously.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from tests.cluster.api import Api, ApiError, Object, Unreachable
from tests.cluster.repeating import repeated

KUBELET_INTERVAL = 0.2  # s between two lists of the pods


def mark_pods_ready(api: Api, selector: str = "", *, namespace: str = "") -> list[str]:
    """Write the status Ready to all pods that match the label selector, as a kubelet would; return the marked pods.

    Skips pods that are ready, are being deleted or are removed meanwhile.
    """
    marked: list[str] = []
    for pod in api.list("Pod", labels=selector, namespace=namespace):
        if "deletionTimestamp" in pod["metadata"] or pod.get("status", {}).get("phase") == "Running":
            continue
        name = str(pod["metadata"]["name"])
        try:
            api.patch("Pod", name, {"status": running(pod)}, namespace=namespace, subresource="status")
        except ApiError as error:
            if error.code == 404:
                continue
            raise
        marked.append(name)
    return marked


def running(pod: Object) -> Object:
    """Return the status of this pod once all its containers run and are ready."""
    since = pod["metadata"]["creationTimestamp"]
    types = ("PodScheduled", "Initialized", "ContainersReady", "Ready")
    return {
        "phase": "Running",
        "startTime": since,
        "conditions": [{"type": each, "status": "True", "lastTransitionTime": since} for each in types],
        "containerStatuses": [
            {
                "name": container["name"],
                "image": container["image"],
                "imageID": "",
                "ready": True,
                "started": True,
                "restartCount": 0,
                "state": {"running": {"startedAt": since}},
            }
            for container in pod["spec"]["containers"]
        ],
    }


@contextmanager
def kubelet(api: Api) -> Iterator[None]:
    """Mark each new pod of the default namespace of `api` ready, for the duration of a `with` block."""

    def mark() -> None:
        with suppress(Unreachable):  # an outage that the test caused
            mark_pods_ready(api)

    with repeated("kubelet", mark, KUBELET_INTERVAL):
        yield
