"""A pod runs with the accounts that the administrator lists, whatever kind it is in."""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.expected_objects import condition, deployment, start_manager, task, template
from tests.cluster.processes import Processes


def test_an_unlisted_account_is_rejected_in_a_kind_unknown_to_the_manager(
    api: Api, processes: Processes, namespace: str
) -> None:
    """ReplicaSets are not among the default kinds; kinds that an administrator adds are checked too."""
    start_manager(processes, namespace, "--allowed-kinds", "apps/v1/ReplicaSet")
    made = deployment() | {"kind": "ReplicaSet"}
    api.create(template("fine", manifests=[made]))
    api.create(task("north", of="fine"))
    running = api.wait_for(
        "ReplicaSet", instance_name("fine", "north"), lambda _: True, what="one without an account is created"
    )
    assert running["spec"]["template"]["spec"]["automountServiceAccountToken"] is False

    made["spec"]["template"]["spec"]["serviceAccountName"] = "admin"
    api.create(template("bad", manifests=[made]))
    refused = api.wait_for(
        "ApplicationTemplate",
        "bad",
        lambda raw: condition(raw, "Accepted").get("status") == "False",
        what="the account is rejected",
    )
    message = condition(refused, "Accepted")["message"]
    for part in ("spec.manifests[0].spec.template.spec.serviceAccountName", "'admin'", "use one of default"):
        assert part in message
