"""The cache key of a result."""

from __future__ import annotations

from pathlib import Path

from detector.mining.tasks import mined_rule, rule_keys
from tests.driving import a_deploy, a_detector, a_rule, a_stream

SIGNALS = [{"name": "v", "stream": "odom", "value": "msg.v"}]


def test_the_cache_key_of_a_rule_covers_exactly_its_dependencies(tmp_path: Path) -> None:
    map_file = tmp_path / "map.geojson"
    map_file.write_text("{}")
    detector = a_detector(a_stream("odom"), maps=[{"file": str(map_file)}])
    fast = a_rule("fast", signals=SIGNALS, when="v > 10")
    often = {"name": "n", "ruleName": "fast", "over": "60s", "aggregate": "Count"}
    rules = [fast, a_rule("often", signals=[often], when="n > 2"), a_rule("slow", signals=SIGNALS, when="v < 1")]
    before = rule_keys(detector, rules)
    changed = rule_keys(detector, [a_rule("fast", signals=SIGNALS, when="v > 11"), *rules[1:]])
    assert {name for name in before if changed[name] != before[name]} == {"fast", "often"}
    with_action = a_rule("fast", signals=SIGNALS, when="v > 10", actions=[a_deploy("help")])
    assert rule_keys(detector, [mined_rule(with_action, record=True), *rules[1:]]) == before
    map_file.write_text('{"type": "FeatureCollection", "features": []}')
    assert not set(rule_keys(detector, rules).values()) & set(before.values())
