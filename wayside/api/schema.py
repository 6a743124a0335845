"""Generates CRDs from the models: pydantic's JSON schema made structural, with Kubernetes' extensions.

The schema for editors is derived from the CRDs.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from wayside.api import API_VERSION, GROUP, KINDS
from wayside.api.base import LABEL, VERSION, Kind, Model

_KEPT = {
    "type", "format", "description", "pattern", "minLength", "maxLength", "minimum", "maximum", "exclusiveMinimum",
    "minItems", "maxItems", "minProperties", "maxProperties", "enum", "default", "required", "nullable",
}  # fmt: skip


_PENDING: dict[str, Any] = {
    "conditions": [
        {
            "type": "Ready",
            "status": "Unknown",
            "reason": "Pending",
            "message": "waiting for the application manager",
            "observedGeneration": 0,
            "lastTransitionTime": "1970-01-01T00:00:00Z",
        }
    ]
}
"""The status of a new object, until the manager writes it: tools take an object without conditions as current."""


def crd(kind: type[Kind]) -> dict[str, Any]:
    """The CustomResourceDefinition of a kind."""
    name = kind.__name__
    version: dict[str, Any] = {
        "name": VERSION,
        "served": True,
        "storage": True,
        "schema": {"openAPIV3Schema": _object_schema(kind)},
        "subresources": {"status": {}},
        "additionalPrinterColumns": [dict(column) for column in kind.printer_columns],
    }
    if kind.selectable_fields:
        version["selectableFields"] = [{"jsonPath": path} for path in kind.selectable_fields]
    return {
        "apiVersion": "apiextensions.k8s.io/v1",
        "kind": "CustomResourceDefinition",
        "metadata": {"name": f"{kind.plural}.{GROUP}"},
        "spec": {
            "group": GROUP,
            "scope": "Namespaced",
            "names": {
                "kind": name,
                "listKind": f"{name}List",
                "plural": kind.plural,
                "singular": name.lower(),
                "shortNames": [kind.short_name],
                "categories": ["wayside"],
            },
            "versions": [version],
        },
    }


def field_names_at(kind: type[Kind], path: Sequence[str | int]) -> list[str]:
    """The names of the fields that an object of the kind has at a path; empty where any name is allowed."""
    node = _object_schema(kind, GenerateJsonSchema)
    for part in path:
        inner = node.get("items") if isinstance(part, int) else node.get("properties", {}).get(part)
        node = inner or node.get("additionalProperties") or {}
    return list(node.get("properties", ()))


class _Described(GenerateJsonSchema):
    """With the descriptions of fields, which are the docstrings below them, and the constraints of models.

    Only this class reads the sources: at the start of a program, that would take too long.
    """

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """pydantic's schema, with descriptions and constraints."""
        found = super().model_schema(schema)
        fields = schema["cls"].model_fields
        for name, text in _docstrings(schema["cls"]):
            found["properties"][fields[name].alias]["description"] = text
        constraints = schema["cls"].constraints if issubclass(schema["cls"], Model) else ()
        rules = [each.validation for each in constraints if each.validation is not None]
        return {**found, "x-kubernetes-validations": rules} if rules else found


def _docstrings(model: type[BaseModel]) -> Iterator[tuple[str, str]]:
    """The docstrings of the model's fields, inherited ones included, each in one line."""
    for each in reversed(model.__mro__):
        definition = _classes(each.__module__).get(each.__name__) if issubclass(each, Model) else None
        for field, below in pairwise(definition.body if definition is not None else ()):
            match field, below:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str() as text)):
                    yield name, " ".join(text.split())


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def _object_schema(kind: type[Kind], generator: type[GenerateJsonSchema] = _Described) -> dict[str, Any]:
    source = kind.model_json_schema(by_alias=True, schema_generator=generator)
    definitions = source.get("$defs", {})
    properties = {field: _structural(source["properties"][field], definitions) for field in ("spec", "status")}
    properties["status"]["default"] = _PENDING
    return {
        "type": "object",
        "description": (kind.__doc__ or "").strip(),
        "required": ["spec"],
        "properties": {
            "apiVersion": {"type": "string"},
            "kind": {"type": "string"},
            "metadata": {
                "type": "object",
                "properties": {"name": {"type": "string", "maxLength": kind.name_limit, "pattern": f"^{LABEL}$"}},
            },
            **properties,
        },
        **({"x-kubernetes-validations": list(kind.object_validations)} if kind.object_validations else {}),
    }


def _structural(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Inline references, turn optional into absent, and keep only the keywords of a structural schema."""
    node = _resolved(node, definitions)
    if "x-wayside-schema" in node:
        return dict(node["x-wayside-schema"])  # structural already
    result = {key: value for key, value in node.items() if key in _KEPT or key.startswith("x-kubernetes-")}
    if "default" in result:
        result["default"] = _without_nulls(result["default"])
        if result["default"] is None:
            del result["default"]
    if result.get("type") == "integer":
        result["format"] = "int64"
    if "exclusiveMinimum" in result:
        result["minimum"] = result.pop("exclusiveMinimum")
        result["exclusiveMinimum"] = True
    if result.get("type") == "object" or "properties" in node:
        if "properties" in node:
            result["properties"] = {name: _structural(child, definitions) for name, child in node["properties"].items()}
        else:
            # A map: a structural schema cannot express the pattern of its keys; the programs check it.
            values = node.get("additionalProperties", {})
            patterned = node.get("patternProperties", {})
            values = next(iter(patterned.values())) if patterned else values
            # pydantic writes `true` if any value is allowed.
            result["additionalProperties"] = _structural(values if isinstance(values, dict) else {}, definitions)
            if result.get("x-kubernetes-preserve-unknown-fields"):
                result.pop("additionalProperties", None)
            if _is_free(result) or _is_free(result.get("additionalProperties", {})):
                # Otherwise, server-side apply records an owner for each key inside.
                result["x-kubernetes-map-type"] = "atomic"
    elif result.get("type") == "array":
        result["items"] = items = _structural(node.get("items", {}), definitions)
        if items.get("description", "") in result.get("description", ""):
            items.pop("description", None)  # `kubectl explain` prints both, one after the other
    elif "type" not in result and "x-kubernetes-int-or-string" not in result:
        result["x-kubernetes-preserve-unknown-fields"] = True
    return result


def _is_free(node: dict[str, Any]) -> bool:
    return bool(node.get("x-kubernetes-preserve-unknown-fields"))


def _without_nulls(value: Any) -> Any:
    """Absent and null mean the same here; a default in a structural schema must not contain null."""
    if isinstance(value, dict):
        return {key: _without_nulls(child) for key, child in value.items() if child is not None}
    return value


def _resolved(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Follow `$ref`, and `anyOf` of one type and null; keywords beside the reference take precedence."""
    beside = {key: value for key, value in node.items() if key not in ("$ref", "anyOf", "allOf")}
    if "type" in beside and "anyOf" in node:
        return beside  # the model defines the schema by hand
    if "$ref" in node:
        target = _resolved(definitions[node["$ref"].rsplit("/", 1)[1]], definitions)
        return {**target, **beside}
    for combinator in ("anyOf", "allOf"):
        if combinator in node:
            choices = [choice for choice in node[combinator] if choice.get("type") != "null"]
            if len(choices) != 1:
                raise ValueError(f"a structural schema cannot express a choice of types: {node}")
            return {**_resolved(choices[0], definitions), **beside}
    return beside


def editor_schema() -> dict[str, Any]:
    """One JSON Schema of all kinds, with which editors complete fields, show descriptions and mark misspelt fields."""
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Wayside",
        "type": "object",
        "required": ["apiVersion", "kind"],
        "properties": {
            "apiVersion": {"const": API_VERSION},
            "kind": {"enum": sorted(KINDS), "description": "The kind of the object."},
        },
        "allOf": [
            {
                "if": {"properties": {"kind": {"const": name}}, "required": ["kind"]},
                "then": _for_editors(crd(kind)["spec"]["versions"][0]["schema"]["openAPIV3Schema"], name),
            }
            for name, kind in sorted(KINDS.items())
        ],
    }


def _for_editors(schema: dict[str, Any], kind: str) -> dict[str, Any]:
    found = _plain({key: value for key, value in schema.items() if key != "properties"})
    properties = {name: _plain(child) for name, child in schema["properties"].items() if name != "status"}
    metadata = properties["metadata"]
    metadata["required"] = ["name"]
    metadata.pop("additionalProperties", None)
    properties["apiVersion"] = {"const": API_VERSION}
    properties["kind"] = {"const": kind}
    return {**found, "properties": {**properties, "status": {}}, "additionalProperties": False}


def _plain(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema without Kubernetes' extensions; an object with named fields allows no others."""
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
