"""Whether any node fits the pods of an object; the message names the field and the value. Pure.

It reads the fields that a template may render from parameters: `nodeName`, `nodeSelector`, and the required node
affinity. The scheduler itself reports taints, resources and all other causes on the pod.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from application_manager.core.health.pods import Trouble, TroubleReason
from application_manager.core.objects.podspecs import at, pod_spec

Labels = Mapping[str, str]
Nodes = Mapping[str, Labels]
"""The labels of nodes, by name."""

_SEVERAL = "-"  # replaces a label's key if there are several
_SHOWN = 5  # existing values in a message


@dataclass(frozen=True, slots=True)
class _Required:
    """A requirement: the message if no node meets it, its field and value, and its terms, of which one must be met."""

    words: str
    field: str
    key: str
    terms: Sequence[Mapping[str, Any]]

    def is_met(self, name: str, labels: Labels) -> bool:
        return any(_meets(each, name, labels) for each in self.terms)


def selects_nodes(live: Mapping[str, Any]) -> bool:
    """Whether the object's pods have requirements on nodes."""
    return any(True for _ in _required(pod_spec(live)))


def unschedulable(live: Mapping[str, Any], nodes: Nodes) -> Trouble | None:
    """Why no node meets the requirements of the object's pods; None if one does."""
    required = list(_required(pod_spec(live)))
    if not required:
        return None
    unmet = [each for each in required if not any(each.is_met(name, labels) for name, labels in nodes.items())]
    together = any(all(each.is_met(name, labels) for each in required) for name, labels in nodes.items())
    if together:
        return None
    if unmet:
        words = "; ".join(f"{each.words}{_instead(each.key, nodes)}" for each in unmet)
    else:
        words = f"no node meets all requirements together: {'; '.join(each.field for each in required)}"
    what = f"{live['kind']} {live['metadata']['name']}"
    message = f"{what} fits no node: {words}. Correct the value, or label a node"
    return Trouble(TroubleReason.UNSCHEDULABLE, message)


def _required(spec: Mapping[str, Any]) -> Iterator[_Required]:
    if name := spec.get("nodeName"):
        term = {"matchFields": [{"operator": "In", "values": [name]}]}
        yield _Required(f"nodeName: there is no node {name}", f"nodeName {name}", "", [term])
    for key, value in sorted((spec.get("nodeSelector") or {}).items()):
        label = f"{key}={value}"
        words, field = f"nodeSelector: no node has the label {label}", f"nodeSelector {label}"
        yield _Required(words, field, key, [{"matchExpressions": [{"key": key, "operator": "In", "values": [value]}]}])
    affinity = at(spec, ("affinity", "nodeAffinity", "requiredDuringSchedulingIgnoredDuringExecution"))
    terms = [each for each in affinity.get("nodeSelectorTerms") or () if _expressions(each)]
    if terms:
        listed = ", or ".join(_words(each) for each in terms)
        words, field = f"affinity.nodeAffinity: no node has {listed}", f"affinity.nodeAffinity {listed}"
        keys = {key for each in terms for key, _, _ in _expressions(each)}
        yield _Required(words, field, keys.pop() if len(keys) == 1 else _SEVERAL, terms)


def _expressions(term: Mapping[str, Any]) -> list[tuple[str, str, list[str]]]:
    """Key, operator and values of a term's requirements; the key is empty for the name of a node."""
    fields = [{**each, "key": ""} for each in term.get("matchFields") or ()]
    found = [*fields, *(term.get("matchExpressions") or ())]
    return [(str(each.get("key")), str(each.get("operator")), each.get("values") or []) for each in found]


def _words(term: Mapping[str, Any]) -> str:
    return " and ".join(_in_words(*each) for each in _expressions(term))


def _in_words(key: str, operator: str, values: Iterable[str]) -> str:
    what, listed = f"the label {key}" if key else "the name", " or ".join(map(str, values))
    match operator:
        case "In":
            return f"{what}={listed}" if key else f"{what} {listed}"
        case "Exists":
            return what
        case "DoesNotExist":
            return f"not {what}"
    return f"{what} {operator} {listed}"


def _meets(term: Mapping[str, Any], name: str, labels: Labels) -> bool:
    """Whether a node meets a term, like in the scheduler (`component-helpers/scheduling/corev1/nodeaffinity`)."""
    return all(
        _holds(operator, name if not key else labels.get(key), list(map(str, values)))
        for key, operator, values in _expressions(term)
    )


def _holds(operator: str, value: str | None, values: list[str]) -> bool:
    match operator:
        case "In":
            return value in values
        case "NotIn":
            return value not in values
        case "Exists":
            return value is not None
        case "DoesNotExist":
            return value is None
        case "Gt" | "Lt":
            try:
                have, limit = int(value or ""), int(values[0])
            except (ValueError, IndexError):
                return False
            return have > limit if operator == "Gt" else have < limit
    return True  # an operator of the future: the scheduler reports it


def _instead(key: str, nodes: Nodes) -> str:
    """The existing alternatives to the required value."""
    if not nodes:
        return " (there are no nodes)"
    if key == _SEVERAL:
        return ""
    found = sorted(nodes) if not key else sorted({labels[key] for labels in nodes.values() if key in labels})
    if not found:
        return " (no node has a label with this key)"
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return f" (there {'is' if len(found) == 1 else 'are'} {', '.join(found[:_SHOWN])}{more})"
