"""A template that could serve some task is never rejected, whatever the results of its examples."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError
from tests.unit.manager_objects import instance, template

DECLARED: dict[str, Any] = {
    "region": {"type": "string", "required": True},
    "lane": {"type": "string"},
    "count": {"type": "integer", "required": True, "minimum": 0},
    "tags": {"type": "array", "items": "string", "required": True},
    "site": {"type": "object"},
    "code": {"type": "string", "required": True, "pattern": "^[0-9]+$"},
}
TEXTS = (
    "${parameters.region}",
    "on ${parameters.lane}",
    "${parameters.lane}",
    "${parameters.lane == null ? 'none' : parameters.lane}",
    "${parameters.tags[1]}",
    "${parameters.tags[0] + parameters.region}",
    "${100 / parameters.count > 3 ? 'few' : 'many'}",
    "at ${parameters.site.x}",
    "${has(parameters.site.x) ? string(parameters.site.x) : 'nowhere'}",
    "${double(parameters.code) + 1}",
    "${double(parameters.region)}",
    "${parameters.region == 'north' ? parameters.lane : parameters.code}",
)
NAMES = ("${instance.name}", "${instance.name}-${parameters.code}", "${instance.name}-${parameters.region}")
VALUES = st.fixed_dictionaries(
    {
        "region": st.sampled_from(["north", "7", "A B"]),
        "count": st.sampled_from([0, 1, 50]),
        "tags": st.lists(st.sampled_from(["a", "b"]), max_size=3),
        "code": st.sampled_from(["1", "42"]),
    },
    optional={"lane": st.sampled_from(["left", ""]), "site": st.sampled_from([{}, {"x": 1}, {"x": "y"}])},
)


@given(
    st.lists(st.sampled_from(TEXTS), min_size=1, max_size=3),
    st.sampled_from(NAMES),
    st.lists(VALUES, min_size=1, max_size=4),
)
def test_a_template_that_renders_for_some_task_is_not_rejected(
    texts: list[str], name: str, tasks: list[dict[str, Any]]
) -> None:
    data = {f"text{number}": text for number, text in enumerate(texts)}
    manifest = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}, "data": data}
    made = template(parameters=DECLARED, manifests=[manifest])
    renderer = Renderer(made, Policy())
    found = template_findings(made, Policy())
    for values in tasks:
        try:
            renderer.render(instance(parameters=values))
        except RenderError:
            continue
        assert not found.problems
