"""All readers and writers of a manifest's pods use the same place for each kind."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.objects.podspecs import (
    POD_TEMPLATES,
    PodSpec,
    pod_spec,
    pods_and_accounts,
    with_pod_template,
)

SPEC = {"nodeName": "here"}


def manifest(kind: str, inner: dict[str, Any]) -> dict[str, Any]:
    for part in reversed(POD_TEMPLATES[kind]):
        inner = {part: inner}
    return {"apiVersion": "v1", "kind": kind, **inner}


@pytest.mark.parametrize("kind", POD_TEMPLATES)
def test_the_pods_of_each_kind_are_found_judged_and_changed(kind: str) -> None:
    made = manifest(kind, {"spec": SPEC})
    assert pod_spec(made) == SPEC
    assert [each.spec for each in pods_and_accounts(made) if isinstance(each, PodSpec)] == [SPEC]
    changed = with_pod_template(made, lambda pod: pod | {"spec": {"nodeName": "there"}})
    assert (pod_spec(changed), pod_spec(made)) == ({"nodeName": "there"}, SPEC)


@pytest.mark.parametrize("wrong", [{}, {"spec": None}, {"spec": "text"}, {"spec": {"template": []}}])
def test_manifests_of_a_wrong_shape_have_no_pods_and_stay_unchanged(wrong: dict[str, Any]) -> None:
    made = {"kind": "Deployment", **wrong}
    assert pod_spec(made) == {}
    assert with_pod_template(made, lambda _: {}) == made
