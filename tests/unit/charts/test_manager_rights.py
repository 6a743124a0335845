"""The roles follow from the allowed kinds and are minimal."""

from __future__ import annotations

import re
import shlex

import pytest
import yaml
from typer.testing import CliRunner

from application_manager.cluster.permissions import report_missing
from application_manager.commands.cli import app
from application_manager.core.objects.policy import PLURALS, KindKey
from application_manager.core.objects.rights import merged_rules, rights, roles
from tests.guides import guide
from wayside.kubernetes.connection import ConfigurationError

DEPLOYMENT: KindKey = ("apps/v1", "Deployment")
ACCOUNT = ("system", "manager")
LEASE = ("system", "application-manager")


def verbs(plurals: dict[KindKey, str]) -> dict[tuple[str, str], set[str]]:
    return {
        (group, resource): set(rule["verbs"])
        for rule in merged_rules(rights(plurals))
        for group in rule["apiGroups"]
        for resource in rule["resources"]
    }


def test_a_kind_that_is_not_allowed_is_in_no_role() -> None:
    found = verbs({DEPLOYMENT: "deployments"})
    assert found["apps", "deployments"] == {"get", "list", "watch", "create", "patch", "delete"}
    assert found["apps", "deployments/scale"] == {"patch"}
    assert found["", "pods"] == {"list", "watch", "patch"}
    assert {group for group, _ in found} == {"", "apps", "coordination.k8s.io", "events.k8s.io", "wayside.dev"}
    assert ("", "secrets") not in found
    assert ("", "secrets") in verbs(dict(PLURALS))


def test_no_right_is_granted_by_wildcard_and_none_can_be_delegated() -> None:
    for rule in merged_rules(rights(dict(PLURALS))):
        assert "*" not in str(rule)
        assert not {"escalate", "bind", "impersonate"} & set(rule["verbs"])


def test_namespaces_have_a_role_each() -> None:
    where = [(each["kind"], each["metadata"].get("namespace")) for each in roles({}, ["a", "b"], LEASE, ACCOUNT)]
    own = [("Role", "system"), ("RoleBinding", "system")]
    assert where == [(kind, each) for each in ("a", "b") for kind in ("Role", "RoleBinding")] + own


def test_all_namespaces_are_readable_and_only_granted_ones_writable() -> None:
    everywhere = roles({DEPLOYMENT: "deployments"}, [], LEASE, ACCOUNT, "m", detectors=True, granted=["a", "b", "a"])
    assert [(each["kind"], each["metadata"].get("namespace")) for each in everywhere] == [
        ("ClusterRole", None),
        ("ClusterRoleBinding", None),
        ("ClusterRole", None),
        ("RoleBinding", "a"),
        ("RoleBinding", "b"),
        ("Role", "system"),
        ("RoleBinding", "system"),
    ]
    reader, bound, writer, granted = everywhere[:4]
    assert {verb for rule in reader["rules"] for verb in rule["verbs"]} == {"get", "list", "watch"}
    assert not {verb for rule in writer["rules"] for verb in rule["verbs"]} & {"get", "list", "watch"}
    assert bound["roleRef"]["name"] == "m"
    assert (granted["roleRef"]["kind"], granted["roleRef"]["name"]) == ("ClusterRole", writer["metadata"]["name"])
    assert everywhere[-2]["rules"][0]["resourceNames"] == ["application-manager"]
    assert all(each["subjects"][0]["name"] == "manager" for each in everywhere if "subjects" in each)


def test_the_command_prints_the_table() -> None:
    done = CliRunner().invoke(app, ["rbac", "--allowed-kinds", "apps/v1/Deployment", "--account", "system/manager"])
    assert done.exit_code == 0
    assert list(yaml.safe_load_all(done.stdout)) == roles({DEPLOYMENT: "deployments"}, [], LEASE, ACCOUNT)


@pytest.mark.parametrize(
    ("arguments", "logged"),
    [
        (["--account", "manager"], "must be NAMESPACE/NAME"),
        (["--allowed-kinds", "rbac.authorization.k8s.io/v1/Role"], "can never be allowed"),
        (["--lease", "wayside-town"], "must be NAME or NAMESPACE/NAME"),
        (["--allowed-kinds", "v1/Secret"], "needs --namespace"),
        (["--namespace", "a", "--grant", "b"], "has no effect with --namespace"),
    ],
)
def test_invalid_combinations_are_refused(arguments: list[str], logged: str) -> None:
    done = CliRunner().invoke(app, ["rbac", *arguments])
    assert done.exit_code == 2
    assert logged in " ".join(done.output.replace("│", " ").split())


def test_an_unknown_kind_is_looked_up_in_the_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBECONFIG", "/nonexistent")
    done = CliRunner().invoke(app, ["rbac", "--allowed-kinds", "example.com/v1/Widget"])
    assert isinstance(done.exception, ConfigurationError)
    assert "cannot look up the plural of example.com/v1/Widget" in str(done.exception)


def test_missing_rights_are_reported_with_their_purpose_and_the_remedy(caplog: pytest.LogCaptureFixture) -> None:
    needed = {(each.resource, each.vital): each for each in rights({DEPLOYMENT: "deployments"})}
    report_missing([(needed["deployments", False], "patch", "a")])
    (logged,) = caplog.messages
    assert logged == (
        "its service account cannot patch deployments of apps in namespace a, so no Deployment of a template is "
        "created, changed or deleted: apply the output of `application-manager rbac`"
    )
    with pytest.raises(ConfigurationError, match="cannot list pods in all namespaces, so statuses"):
        report_missing([(needed["pods", True], "list", None)])


def test_the_guides_command_prints_the_rights_of_the_guides_manager() -> None:
    text = guide("manager").replace("\\\n", " ")
    command, run = (
        shlex.split(line.partition("|")[0])[2:]
        for line in text.splitlines()
        if re.match(r"\$ application-manager r[bu]", line)
    )
    assert (command[0], run[0]) == ("rbac", "run")
    assert [each for each in run[1:] if each not in command] == [], "both mean the same kinds and namespaces"
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0
    kinds = {each["kind"] for each in yaml.safe_load_all(done.stdout)}
    assert kinds == {"Role", "RoleBinding"}
