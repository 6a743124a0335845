"""Playing the kubelet: there are no nodes here, so nothing but a test says that a pod runs."""

from __future__ import annotations

from tests.cluster.api import Api, ApiError, Object


def mark_pods_ready(api: Api, selector: str = "", *, namespace: str = "") -> list[str]:
    """Write the status Ready to all pods that match the label selector, as a kubelet would; return their names.

    Pods that are being deleted, or vanish meanwhile, are left out. Marking twice changes nothing.
    """
    marked: list[str] = []
    for pod in api.list("Pod", labels=selector, namespace=namespace):
        if "deletionTimestamp" in pod["metadata"]:
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
