"""One JSON Schema of all kinds, with which editors complete fields, show descriptions and mark misspelt fields."""

from __future__ import annotations

from typing import Any

from wayside.api import GROUP, KINDS
from wayside.api.base import VERSION
from wayside.api.schema import crd


def editor_schema() -> dict[str, Any]:
    """The schema of a YAML document of any of the kinds; the field `kind` selects one."""
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Wayside",
        "type": "object",
        "required": ["apiVersion", "kind"],
        "properties": {
            "apiVersion": {"const": f"{GROUP}/{VERSION}"},
            "kind": {"enum": sorted(KINDS), "description": "Which kind of object the document is."},
        },
        "allOf": [
            {
                "if": {"properties": {"kind": {"const": name}}, "required": ["kind"]},
                "then": _object(crd(kind)["spec"]["versions"][0]["schema"]["openAPIV3Schema"], name),
            }
            for name, kind in sorted(KINDS.items())
        ],
    }


def _object(schema: dict[str, Any], kind: str) -> dict[str, Any]:
    found = _plain({key: value for key, value in schema.items() if key != "properties"})
    properties = {name: _plain(child) for name, child in schema["properties"].items() if name != "status"}
    metadata = properties["metadata"]
    metadata["required"] = ["name"]
    metadata.pop("additionalProperties", None)
    properties["apiVersion"] = {"const": f"{GROUP}/{VERSION}"}
    properties["kind"] = {"const": kind}
    return {**found, "properties": {**properties, "status": {}}, "additionalProperties": False}


def _plain(schema: dict[str, Any]) -> dict[str, Any]:
    """The same without what only Kubernetes knows; a map with named fields has no others."""
    found = {key: value for key, value in schema.items() if not key.startswith("x-kubernetes-") and key != "nullable"}
    if found.pop("exclusiveMinimum", False):
        found["exclusiveMinimum"] = found.pop("minimum")
    if "properties" in found:
        found["properties"] = {name: _plain(child) for name, child in found["properties"].items()}
        if not schema.get("x-kubernetes-preserve-unknown-fields"):
            found["additionalProperties"] = False
    elif isinstance(found.get("additionalProperties"), dict):
        found["additionalProperties"] = _plain(found["additionalProperties"])
    if isinstance(found.get("items"), dict):
        found["items"] = _plain(found["items"])
    return found
