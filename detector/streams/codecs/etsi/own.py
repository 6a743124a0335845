"""ASN.1 definitions from the user's files: read and resolved by asn1tools (MIT).

asn1tools provides the types. It lacks the types of open types, which are looked up in the text: `{Type IDENTIFIED BY
value}` of an information object set gives them.

It also uses only the first of several ranges: `(unknown | passengerCar..tram)` would be one number without any bit. So
before it resolves them, `span_constraints` replaces several ranges by the one that spans them (X.691 10.3.21).
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from detector.streams.codecs.etsi import asn1
from detector.streams.codecs.etsi.packaged import ALPHABETS, REMEDY
from detector.streams.codecs.etsi.quantities import UNITS
from wayside.api.stream import Asn1Module

_SUCCESSORS = re.compile(r"\bWITH\s+(SUCCESSORS|DESCENDANTS)\b")
"""Permits a later version of a module; asn1tools does not know it."""

_COMMENT = re.compile(r"/\*.*?\*/|--.*?(?:--|$)", re.DOTALL | re.MULTILINE)

_OBJECT_SET = re.compile(r"\b([A-Z][\w-]*)\s+([A-Z][A-Z0-9-]*)\s*::=\s*\{")
_ROW = re.compile(r"\{\s*([A-Z][\w-]*)\s+IDENTIFIED\s+BY\s+([\w-]+)\s*\}")

_Tree = Mapping[str, Any]
"""A module parsed by asn1tools."""


class OwnDefinitions:
    """The types of some ASN.1 modules, by name."""

    def __init__(self, texts: Sequence[str]) -> None:
        """`texts` contain one or several modules each. Raises DefinitionError if they cannot be read or resolved."""
        self._trees: dict[str, _Tree] = {}
        self._rows: dict[str, list[tuple[str, str]]] = {}
        for text in texts:
            self._trees.update(copy.deepcopy(parsed_modules(text)))
            self._rows.update(_object_sets(text))
        span_constraints(self._trees)
        self._types = _compiled(self._trees)
        self._done: dict[int, tuple[Any, asn1.Type]] = {}

    def type(self, names: Iterable[str]) -> asn1.Type | None:
        """The first existing type of these names."""
        for name in names:
            for types in self._types.values():
                if name in types:
                    return self._walk(types[name], name)
        return None

    def _walk(self, found: Any, name: str = "") -> asn1.Type:
        """`name` is the type's, if the compiled type itself does not have it."""
        made = self._done.get(id(found))
        if made is None:
            made = self._done[id(found)] = (found, self._convert(found, name or found.type_name))
        return made[1]

    def _convert(self, found: Any, name: str) -> asn1.Type:
        kind = type(found).__name__
        match kind:
            case "Boolean":
                return asn1.Boolean()
            case "Null":
                return asn1.Null()
            case "Integer":
                extensible = bool(found.has_extension_marker)
                names = aliases(name, self._trees)
                unit = next((each for each in names if each in UNITS), name)
                return asn1.Integer(unit, found.minimum, found.maximum, extensible, named_numbers(names, self._trees))
            case "Enumerated":
                additions = found.additions_index_to_data
                return asn1.Enumerated(
                    tuple(found.root_index_to_data[index] for index in sorted(found.root_index_to_data)),
                    None if additions is None else tuple(additions[index] for index in sorted(additions)),
                )
            case "BitString":
                named = found.named_bits or ()
                return asn1.BitString(_size(found), {int(position): bit for bit, position in named})
            case "OctetString":
                return asn1.OctetString(_size(found))
            case "SequenceOf" | "SetOf":
                return asn1.SequenceOf(self._walk(found.element_type), _size(found))
            case "Sequence":
                return self._sequence(found, name)
            case "Choice":
                additions = found.additions_index_to_member
                return asn1.Choice(
                    self._alternatives(found.root_index_to_member),
                    None if additions is None else self._alternatives(additions),
                )
            case "OpenType":
                return asn1.Open("", {})
            case "UTF8String":
                return asn1.Text(asn1.ANY_SIZE, None)
            case _ if kind in ALPHABETS and len(found.permitted_alphabet) == len(ALPHABETS[kind] or ""):
                return asn1.Text(_size(found), ALPHABETS[kind])
            case _:
                return asn1.Unreadable(kind)

    def _alternatives(self, members: Mapping[int, Any]) -> tuple[tuple[str, asn1.Type], ...]:
        return tuple((members[index].name, self._walk(members[index])) for index in sorted(members))

    def _sequence(self, found: Any, name: str) -> asn1.Sequence:
        opened = self._open_types(name)
        root = tuple(self._field(member, opened) for member in found.root_members)
        if found.additions is None:
            return asn1.Sequence(name, root, None)
        additions = [
            asn1.Group(tuple(self._field(inner, opened) for inner in member.root_members))
            if type(member).__name__ == "AdditionGroup"
            else self._field(member, opened)
            for member in found.additions
        ]
        return asn1.Sequence(name, root, tuple(additions))

    def _field(self, member: Any, opened: Mapping[str, asn1.Type]) -> asn1.Field:
        kind = opened.get(member.name) or self._walk(member)
        return asn1.Field(member.name, kind, member.optional or member.default is not None, member.default)

    def _open_types(self, name: str) -> dict[str, asn1.Type]:
        """The open types of a SEQUENCE, by component; the type of each depends on another component."""
        opened: dict[str, asn1.Type] = {}
        for member in type_tree(name, self._trees).get("members", ()):
            if not isinstance(member, dict) or not str(member.get("type")).endswith(".&Type"):
                continue
            match member.get("table"):
                case [str(object_set), [str(selector), *_]]:
                    opened[member["name"]] = asn1.Open(selector, self._table(object_set))
        return opened

    def _table(self, object_set: str) -> dict[int, asn1.Type]:
        table: dict[int, asn1.Type] = {}
        for type_name, value in self._rows.get(object_set, ()):
            number = int(value) if value.isdigit() else named_number(value, self._trees)
            kind = self.type([type_name])
            if number is not None and kind is not None:
                table[number] = kind
        return table


@lru_cache(maxsize=64)
def parsed_modules(text: str) -> dict[str, Any]:
    """The modules in the text. Raises DefinitionError, with line and column, if it is not ASN.1."""
    tools = _asn1tools()
    try:
        return dict(tools.parse_string(_SUCCESSORS.sub(lambda found: " " * len(found[0]), text)))
    except tools.ParseError as error:
        raise asn1.DefinitionError(f"not valid ASN.1: {error}") from None
    except RecursionError:
        raise asn1.DefinitionError("not valid ASN.1: it is nested too deeply") from None


def read_module(module: Asn1Module) -> str:
    """The text of ASN.1 modules, after validation. Raises DefinitionError."""
    text = module.definition
    if text is None:
        try:
            text = Path(module.file or "").read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise asn1.DefinitionError(f"cannot read {module.file}: {error}") from error
    parsed_modules(text)
    return text


@lru_cache(maxsize=8)
def own_definitions(texts: tuple[str, ...]) -> OwnDefinitions:
    """The definitions of these texts, cached. Raises DefinitionError."""
    return OwnDefinitions(texts)


def _compiled(trees: Mapping[str, _Tree]) -> dict[str, dict[str, Any]]:
    """asn1tools' types by module and name."""
    tools = _asn1tools()
    try:
        specification = tools.compile_dict(copy.deepcopy(dict(trees)), "uper")
    except tools.CompileError as error:
        raise asn1.DefinitionError(
            f"the ASN.1 modules are incomplete: {str(error).rstrip('.')}: give all modules that they import"
        ) from None
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise asn1.DefinitionError(f"cannot resolve the ASN.1 modules: {error!r}") from None
    return {
        module: {name: _inner(kind) for name, kind in types.items()} for module, types in specification.modules.items()
    }


def _inner(compiled: Any) -> Any:
    while hasattr(compiled, "_type"):
        compiled = compiled._type
    return compiled


def _asn1tools() -> Any:
    try:
        import asn1tools  # noqa: PLC0415  slow, and only needed for the user's ASN.1 files
    except ImportError as error:
        raise asn1.DefinitionError(f"the ASN.1 reader is not installed: {REMEDY}") from error
    return asn1tools


def _size(found: Any) -> asn1.Size:
    if found.minimum is None:
        return asn1.ANY_SIZE
    low = 0 if found.minimum == "MIN" else int(found.minimum)
    high = None if found.maximum in (None, "MAX") else int(found.maximum)
    return asn1.Size(low, high, bool(found.has_extension_marker))


def _object_sets(text: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """The information object sets: the rows of type and value, by name."""
    text = _COMMENT.sub(" ", text)
    for found in _OBJECT_SET.finditer(text):
        depth, end = 1, found.end()
        while depth and end < len(text):
            depth += {"{": 1, "}": -1}.get(text[end], 0)
            end += 1
        rows = _ROW.findall(text[found.end() : end])
        if rows:
            yield found[1], rows


_MARKER = None
"""How asn1tools represents `...`."""


def span_constraints(trees: Mapping[str, Any]) -> None:
    """Replaces constraints of several ranges by one, in modules parsed by asn1tools."""
    for tree in trees.values():
        _visit(tree["types"], trees)


def _visit(node: Any, trees: Mapping[str, Any]) -> None:
    if isinstance(node, dict):
        for name in ("restricted-to", "size"):
            ranges = node.get(name)
            if isinstance(ranges, list) and len(_root(ranges)) > 1:
                spanned = _span(_root(ranges), node, trees)
                if spanned is not None:
                    node[name] = [spanned, _MARKER] if _MARKER in ranges else [spanned]
        for value in node.values():
            _visit(value, trees)
    elif isinstance(node, list):
        for value in node:
            _visit(value, trees)


def _root(ranges: list[Any]) -> list[Any]:
    """The part before the extension marker."""
    return ranges[: ranges.index(_MARKER)] if _MARKER in ranges else ranges


def _span(ranges: list[Any], node: Mapping[str, Any], trees: Mapping[str, Any]) -> tuple[int, int] | None:
    """From the lowest to the highest; None if a bound is unknown, which asn1tools reports."""
    ends = [end for each in ranges for end in (each if isinstance(each, tuple) else (each,))]
    numbers = [_number(end, node, trees) for end in ends]
    known = [number for number in numbers if number is not None]
    return (min(known), max(known)) if len(known) == len(numbers) else None


def _number(end: Any, node: Mapping[str, Any], trees: Mapping[str, Any]) -> int | None:
    if isinstance(end, int):
        return end
    if not isinstance(end, str):
        return None
    if end.lstrip("-").isdigit():
        return int(end)
    named = named_numbers(aliases(str(node.get("type", "")), trees), trees) | dict(node.get("named-numbers", {}))
    return named[end] if end in named else named_number(end, trees)


def type_tree(name: str, trees: Mapping[str, Any]) -> Mapping[str, Any]:
    """The definition of the type, in any of the modules; empty if there is none."""
    return next((tree["types"][name] for tree in trees.values() if name in tree["types"]), {})


def aliases(name: str, trees: Mapping[str, Any]) -> list[str]:
    """The name of the type, and its aliases."""
    names: list[str] = []
    while name and name not in names:
        names.append(name)
        name = str(type_tree(name, trees).get("type", ""))
    return names


def named_numbers(names: list[str], trees: Mapping[str, Any]) -> dict[str, int]:
    """The named numbers of the first of these INTEGER types that has any."""
    found = (type_tree(name, trees) for name in names)
    return next((dict(tree["named-numbers"]) for tree in found if "named-numbers" in tree), {})


def named_number(name: str, trees: Mapping[str, Any]) -> int | None:
    """The number with that name in the modules."""
    for tree in trees.values():
        found = tree["values"].get(name)
        if found is not None and isinstance(found["value"], int):
            return int(found["value"])
    return None
