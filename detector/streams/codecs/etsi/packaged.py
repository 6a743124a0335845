"""ASN.1 definitions from the package pycrate, which contains those of CAM, DENM, MAPEM, SPATEM and an early VAM.

Only the type definitions of pycrate (LGPL) are used; `reading` reads the bytes. Importing one of its modules takes some
tenths of a second, so it happens when a stream needs it.
"""

from __future__ import annotations

import importlib
from typing import Any

from detector.streams.codecs.etsi import asn1

REMEDY = "pip install 'wayside[etsi]'"

ALPHABETS = {
    "IA5String": "".join(map(chr, range(128))),
    "VisibleString": "".join(map(chr, range(32, 127))),
    "NumericString": " 0123456789",
    "PrintableString": "".join(
        sorted(" '()+,-./:=?" + "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz")
    ),
    "UTF8String": None,
}


def packaged_type(package: str, module: str, name: str) -> asn1.Type:
    """The type of that name, e.g. ("ITS_CAM_2", "CAM_PDU_Descriptions", "CAM").

    Raises DefinitionError if pycrate is not installed.
    """
    try:
        imported = importlib.import_module(f"pycrate_asn1dir.{package}")
    except ImportError as error:
        raise asn1.DefinitionError(f"the ASN.1 definitions of {name} are not installed: {REMEDY}") from error
    return _Walk().type(getattr(getattr(imported, module), name))


class _Walk:
    """Visits pycrate's objects, each once."""

    def __init__(self) -> None:
        self._done: dict[int, asn1.Type] = {}

    def type(self, found: Any) -> asn1.Type:
        """The type of a pycrate object."""
        made = self._done.get(id(found))
        if made is None:
            made = self._done[id(found)] = self._convert(found)
        return made

    def _convert(self, found: Any) -> asn1.Type:
        kind = found.TYPE
        match kind:
            case "BOOLEAN":
                return asn1.Boolean()
            case "NULL":
                return asn1.Null()
            case "INTEGER":
                bounds = found._const_val
                return asn1.Integer(
                    _name(found),
                    None if bounds is None else bounds.lb,
                    None if bounds is None else bounds.ub,
                    bounds is not None and bounds.ext is not None,
                    dict(found._cont or {}),
                )
            case "ENUMERATED":
                root = sorted(found._root, key=found._cont.__getitem__)
                return asn1.Enumerated(tuple(root), None if found._ext is None else tuple(found._ext))
            case "BIT STRING":
                return asn1.BitString(_size(found), {value: name for name, value in dict(found._cont or {}).items()})
            case "OCTET STRING":
                inner = getattr(found, "_const_cont", None)
                return asn1.OctetString(_size(found), None if inner is None else self.type(inner))
            case "SEQUENCE OF" | "SET OF":
                return asn1.SequenceOf(self.type(found._cont), _size(found))
            case "SEQUENCE":
                return self._sequence(found)
            case "CHOICE":
                return asn1.Choice(
                    tuple((name, self.type(found._cont[name])) for name in found._root),
                    None if found._ext is None else tuple((name, self.type(found._cont[name])) for name in found._ext),
                )
            case "OPEN_TYPE":
                return self._open(found)
            case _ if kind in ALPHABETS and getattr(found, "_const_alpha", None) is None:
                return asn1.Text(_size(found), ALPHABETS[kind])
            case _:
                return asn1.Unreadable(kind)

    def _sequence(self, found: Any) -> asn1.Sequence:
        additions: list[asn1.Field | asn1.Group] | None = None
        if found._ext is not None:
            additions = []
            for nest in found._ext_nest:
                names = [nest] if isinstance(nest, str) else list(nest)
                fields = tuple(self._field(name, found._cont[name]) for name in names)
                grouped = names[0] in found._ext_ident
                additions.append(asn1.Group(fields) if grouped else fields[0])
        root = tuple(self._field(name, found._cont[name]) for name in found._root)
        return asn1.Sequence(_name(found), root, None if additions is None else tuple(additions))

    def _field(self, name: str, found: Any) -> asn1.Field:
        return asn1.Field(name, self.type(found), bool(found._opt) or found._def is not None, found._def)

    def _open(self, found: Any) -> asn1.Open:
        """An open type of the only kind in ITS messages: a regional extension, identified by its regionId."""
        table = found._const_tab
        entries = [] if table is None else [row for row in table._val.root if "Type" in row]
        return asn1.Open("regionId", {row["id"]: self.type(row["Type"]) for row in entries})


def _name(found: Any) -> str:
    reference = found._typeref
    name = getattr(reference, "called", None)
    return str(name[1]) if isinstance(name, tuple) and len(name) == 2 else str(found._name or "")


def _size(found: Any) -> asn1.Size:
    bounds = found._const_sz
    if bounds is None:
        return asn1.ANY_SIZE
    return asn1.Size(bounds.lb or 0, bounds.ub, bounds.ext is not None)
