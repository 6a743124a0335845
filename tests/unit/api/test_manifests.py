"""Objects as YAML text."""

from __future__ import annotations

import yaml

from wayside.manifests import to_yaml


def test_a_lone_y_or_n_is_quoted_since_kubectl_takes_it_for_a_boolean() -> None:
    assert to_yaml([{"position": {"x": 1.0, "y": 2.0}, "n": "N", "list": ["Y"]}]) == (
        "position:\n  x: 1.0\n  'y': 2.0\n'n': 'N'\nlist:\n- 'Y'\n"
    )


def test_several_documents_read_back_as_they_were() -> None:
    objects = [{"kind": "A", "text": "a: b\nc"}, {"kind": "B", "answer": "yes", "number": "1", "none": None}]
    assert list(yaml.safe_load_all(to_yaml(objects))) == objects


def test_repeated_objects_are_written_without_aliases() -> None:
    shared = {"a": [1]}
    assert "&" not in to_yaml([{"first": shared, "second": shared}])
