"""The alerts of the chart fire when they should; alerts and dashboard query only exported metrics."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import yaml
from prometheus_client.parser import text_string_to_metric_families

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.objects.policy import Policy
from application_manager.measures import Measures
from application_manager.observability.overview import Overview
from charts.generate import FILES
from detector.status.metrics import Metrics
from detector.status.model import CertificateStatus
from tests.driving import Drive, a_detector, arrival
from tests.promtool import find_promtool
from tests.unit.statuses.test_status import FAST, ObservedEngine

ALERTS = FILES / "monitoring" / "alerts.yaml"
DASHBOARD = FILES / "monitoring" / "dashboard.json"
CASES = Path(__file__).parent / "chart_alerts.yaml"
NAME = re.compile(r"\b(?:wayside|process)_[a-z_]+\b")


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]]


def expressions() -> list[str]:
    panels = json.loads(DASHBOARD.read_text())["panels"]
    return [rule["expr"] for rule in rules()] + [
        target["expr"] for panel in panels for target in panel.get("targets", [])
    ]


def exported() -> set[str]:
    """The names of all samples of both programs."""
    measures = Measures()
    measures.registry.register(Overview(ClusterCache(Policy()), lambda: [("task", 0, 0)]))
    taken = ObservedEngine(Drive(a_detector(), FAST)).take(arrival(0.5, "car", {"v": 20}), until=1)
    status = msgspec.structs.replace(taken, certificate=CertificateStatus(expires=1.0))
    texts = measures.text().decode(), Metrics(lambda: status).text().decode()
    found = set()
    for text in texts:
        for family in text_string_to_metric_families(text):
            if family.type == "histogram":  # one with labels has no samples before the first observation
                found |= {f"{family.name}{end}" for end in ("_bucket", "_sum", "_count")}
            elif family.type == "counter":
                found.add(f"{family.name}_total")
            else:
                found.add(family.name)
    return found


def test_alerts_and_dashboard_query_only_what_the_programs_export() -> None:
    requested = {name for each in expressions() for name in NAME.findall(each)}
    assert len(requested) > 20
    assert requested - exported() == set()


def test_every_panel_filters_by_the_dashboard_variables() -> None:
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        for target in panel.get("targets", []):
            assert target["expr"].count('{namespace=~"$namespace"}') == len(NAME.findall(target["expr"]))


def test_every_alert_has_a_description_and_a_test_case_in_which_it_fires() -> None:
    cases = yaml.safe_load(CASES.read_text())["tests"]
    fired = {each["alertname"] for case in cases for each in case["alert_rule_test"] if each.get("exp_alerts")}
    silent = {each["alertname"] for case in cases for each in case["alert_rule_test"] if not each.get("exp_alerts")}
    names = {rule["alert"] for rule in rules()}
    assert fired == names
    assert silent == names
    for rule in rules():
        assert {"summary", "description"} == rule["annotations"].keys()
        assert rule["labels"]["severity"] in ("critical", "warning")


def test_the_alerts_fire_when_they_should_and_only_then(tmp_path: Path) -> None:
    shutil.copy(ALERTS, tmp_path)
    shutil.copy(CASES, tmp_path)
    command = [str(find_promtool()), "test", "rules", str(tmp_path / CASES.name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
