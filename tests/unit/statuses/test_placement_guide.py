"""The guide's template is placed by its parameters, and the guide's message is the manager's."""

from __future__ import annotations

import yaml

from application_manager.core.demand.demand import demand
from application_manager.core.demand.drafting import draft
from application_manager.core.health.placement import unschedulable
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from tests.guides import guide, yaml_blocks
from tests.unit.manager_objects import NOW, task
from wayside.api import ApplicationTemplate

GUIDE = guide("placement")
NODES = {name: {"kubernetes.io/hostname": name} for name in ("rsu-1", "rsu-2")}


def test_the_guides_template_is_placed_by_its_parameters() -> None:
    raw = yaml.safe_load(yaml_blocks(GUIDE)[0])
    raw["metadata"]["namespace"] = "site"
    template = ApplicationTemplate.model_validate(raw)
    live = task("a", {"node": "rsu-9"}, of=template.name)
    (decision,) = demand([template], [live], [], {}, NOW).instances.values()
    wanted = draft(("site", decision.name), decision, None)
    (manifest,) = Renderer(template, Policy()).render(wanted).manifests
    spec = manifest["spec"]["template"]["spec"]
    assert spec["nodeSelector"] == {"kubernetes.io/hostname": "rsu-9"}
    assert spec["tolerations"] == [{"key": "site", "value": "edge", "effect": "NoSchedule"}]
    found = unschedulable(manifest, NODES)
    assert found is not None
    reported = found.message.replace(decision.name, "at-the-roadside-abc")
    assert f"`{reported}`" in " ".join(GUIDE.split())
