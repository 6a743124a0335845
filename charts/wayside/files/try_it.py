"""`helm test`: the manager is ready, and its webhook responds to the API server with a trusted certificate.

Arguments: the URL of /readyz, and the file of its authority, empty without TLS; with the webhook also its URL,
the file of its authority, and a namespace that the manager manages.
"""

import json
import ssl
import sys
import time
import urllib.request

PATIENCE = 60.0  # s; just after an install the Services have no endpoints yet
WRONG = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationTemplate",
    "metadata": {"name": "wrong"},
    "spec": {"manifests": [{"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "${there.is.none}"}}]},
}


def ready(base, authority):
    """Report that the manager is ready. Raises OSError if it is not."""
    context = ssl.create_default_context(cafile=authority) if authority else None
    with urllib.request.urlopen(f"{base}/readyz", timeout=5, context=context) as answer:
        print("the manager is ready:", answer.read().decode().strip())


def refuses(base, authority, namespace):
    """Report that the webhook rejects an invalid template; OSError if not, or if its certificate is invalid."""
    group = {"group": "wayside.dev", "version": "v1alpha1"}
    request = {
        "uid": "test",
        "kind": group | {"kind": "ApplicationTemplate"},
        "resource": group | {"resource": "applicationtemplates"},
        "name": "wrong",
        "namespace": namespace,
        "operation": "CREATE",
        "object": WRONG | {"metadata": WRONG["metadata"] | {"namespace": namespace}},
        "userInfo": {},
        "dryRun": True,
    }
    review = json.dumps({"apiVersion": "admission.k8s.io/v1", "kind": "AdmissionReview", "request": request})
    query = urllib.request.Request(f"{base}/admission", review.encode(), {"Content-Type": "application/json"})
    with urllib.request.urlopen(query, timeout=5, context=ssl.create_default_context(cafile=authority)) as answer:
        response = json.load(answer)["response"]
    if response["allowed"]:
        raise OSError("a template that is wrong is not refused")
    print("the webhook refuses what is wrong:", response["status"]["message"])


def wait(check, *arguments):
    """Retry until it succeeds; exit with the error if that takes too long."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return check(*arguments)
        except OSError as error:
            if time.monotonic() > end:
                sys.exit(f"{arguments[0]}: {error}")
        time.sleep(1)


wait(ready, *sys.argv[1:3])
if len(sys.argv) > 3:
    wait(refuses, *sys.argv[3:])
