"""Playing the kubelet: there are no nodes here, so nothing but a test says that a pod runs.

`mark_pods_ready` does it once, `Kubelet` goes on doing it.
"""

from __future__ import annotations

import threading
from types import TracebackType

from tests.cluster.api import Api, ApiError, Object, Unreachable

KUBELET_INTERVAL = 0.2  # s between two looks at the pods


def mark_pods_ready(api: Api, selector: str = "", *, namespace: str = "") -> list[str]:
    """Write the status Ready to all pods that match the label selector, as a kubelet would; return whom it marked.

    Pods that are ready or being deleted, or vanish meanwhile, are left out.
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


class Kubelet:
    """Marks each new pod of a namespace ready, for the duration of a `with` block."""

    def __init__(self, api: Api):
        """Prepare, for the default namespace of `api`."""
        self._api = api
        self._ended = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="kubelet", daemon=True)

    def _run(self) -> None:
        try:
            while not self._ended.wait(KUBELET_INTERVAL):
                try:
                    mark_pods_ready(self._api)
                except Unreachable:
                    continue  # an outage that the test brought about
        except Exception as error:  # noqa: BLE001  not lost: the end of the block raises it
            self._failure = error

    def __enter__(self) -> Kubelet:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        if self._failure is not None and error is None:
            raise self._failure
