"""ASN.1 modules that the user brings, against asn1tools as encoder."""

from __future__ import annotations

import copy
import random
import re
from pathlib import Path
from typing import Any

import asn1tools
import pytest

from detector.assembly import DetectorError, stream_readers
from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.etsi import EtsiDecoder, OwnDefinitions
from detector.streams.codecs.etsi.bits import Bits
from detector.streams.codecs.etsi.own import parsed_modules, span_constraints
from detector.streams.codecs.etsi.reading import Readers
from tests.driving import a_detector
from tests.unit.encodings.its_messages import a_cam

SECOND = 10**9

PERCEPTION = """
Perception {wayside perception(1)} DEFINITIONS AUTOMATIC TAGS ::= BEGIN
IMPORTS Header, SpeedValue, TimestampIts, Kind FROM Dictionary {wayside dictionary(2)} WITH SUCCESSORS;
CollectivePerceptionMessage ::= SEQUENCE { header Header (WITH COMPONENTS {..., messageId(14)}), payload Payload }
Payload ::= SEQUENCE {
    managementContainer SEQUENCE { referenceTime TimestampIts, ... },
    parts SEQUENCE SIZE(1..4, ...) OF Part,
    ...,
    late-part BOOLEAN,
    [[ grouped INTEGER (0..7), further Kind OPTIONAL ]]
}
PART ::= CLASS { &id PartId UNIQUE, &Type } WITH SYNTAX {&Type IDENTIFIED BY &id}
PartId ::= INTEGER (1..16)
sizes PartId ::= 1
speeds PartId ::= 5
Parts PART ::= { {Sizes IDENTIFIED BY sizes} | -- a comment -- {Speeds IDENTIFIED BY speeds}, ... }
Part ::= SEQUENCE { partId PART.&id ({Parts}), partData PART.&Type ({Parts}{@partId}) }
Sizes ::= SEQUENCE { length ObjectDimensionValue, ... }
ObjectDimensionValue ::= INTEGER { outOfRange(255), unavailable(256) } (1..256)
Speeds ::= SEQUENCE OF SpeedValue
END
"""

DICTIONARY = """
Dictionary {wayside dictionary(2)} DEFINITIONS AUTOMATIC TAGS ::= BEGIN
Header ::= SEQUENCE {
    protocolVersion INTEGER (0..255), messageId INTEGER (0..255), stationId INTEGER (0..4294967295)
}
SpeedValue ::= INTEGER { outOfRange(16382), unavailable(16383) } (0..16383)
TimestampIts ::= INTEGER (0..4398046511103)
Kind ::= ENUMERATED { car(0), bus(1), ..., tram(2) }
END
"""


def encoder(*texts: str) -> Any:
    tree: dict[str, Any] = {}
    for text in texts:
        tree.update(copy.deepcopy(parsed_modules(text)))
    span_constraints(tree)
    return asn1tools.compile_dict(tree, "uper")


def perception(**payload: Any) -> bytes:
    tools = encoder(DICTIONARY, PERCEPTION)
    value = {
        "header": {"protocolVersion": 2, "messageId": 14, "stationId": 7},
        "payload": {
            "managementContainer": {"referenceTime": 694_310_405_000},
            "parts": [
                {"partId": 1, "partData": tools.encode("Sizes", {"length": 45})},
                {"partId": 5, "partData": tools.encode("Speeds", [1389, 16383])},
                {"partId": 9, "partData": b"\x01\x02"},
            ],
            **payload,
        },
    }
    return bytes(tools.encode("CollectivePerceptionMessage", value))


def test_a_message_that_no_package_defines_is_read_by_the_users_modules() -> None:
    decoder = EtsiDecoder("etsi/cpm", OwnDefinitions((PERCEPTION, DICTIONARY)))
    raw = perception()
    assert decoder.decode(raw) == {
        "header": {"protocolVersion": 2.0, "messageId": 14.0, "stationId": 7.0},
        "payload": {
            "managementContainer": {"referenceTime": 1_767_225_600.0},
            "parts": [
                {"partId": 1.0, "partData": {"length": 4.5}},
                {"partId": 5.0, "partData": [13.89, None]},
                {"partId": 9.0, "partData": b"\x01\x02"},
            ],
        },
    }
    assert decoder.stamp_near(raw, 0) == 1_767_225_600 * SECOND


@pytest.mark.parametrize(
    ("sent", "seen"),
    [
        ({"late-part": True}, {"late_part": True}),
        ({"late-part": False, "grouped": 5}, {"late_part": False, "grouped": 5.0}),
        ({"late-part": True, "grouped": 0, "further": "bus"}, {"late_part": True, "grouped": 0.0, "further": "bus"}),
        ({"late-part": True, "grouped": 0, "further": "tram"}, {"late_part": True, "grouped": 0.0, "further": "tram"}),
    ],
)
def test_known_extensions_are_read_and_unknown_ones_are_skipped(sent: dict[str, Any], seen: dict[str, Any]) -> None:
    raw = perception(**sent)
    now = EtsiDecoder("etsi/cpm", OwnDefinitions((PERCEPTION, DICTIONARY))).decode(raw)["payload"]
    assert {key: now[key] for key in now if key not in ("managementContainer", "parts")} == seen
    older = re.sub(r"\.\.\.,\s*late-part.*?\]\]", "...", PERCEPTION, flags=re.DOTALL)
    before = EtsiDecoder("etsi/cpm", OwnDefinitions((older, DICTIONARY))).decode(raw)["payload"]
    assert set(before) == {"managementContainer", "parts"}
    assert before["parts"] == now["parts"]


def test_the_users_modules_leave_messages_of_other_kinds_and_of_the_first_version_alone() -> None:
    decoder = EtsiDecoder(None, OwnDefinitions((PERCEPTION, DICTIONARY)))
    assert decoder.decode(a_cam(station=9))["header"]["stationId"] == 9.0
    assert decoder.decode(perception())["header"]["messageId"] == 14.0


def test_a_message_without_a_standard_time_field_has_no_stamp() -> None:
    elsewhere = PERCEPTION.replace("managementContainer SEQUENCE", "timing SEQUENCE")
    tools = encoder(DICTIONARY, elsewhere)
    header = {"protocolVersion": 2, "messageId": 14, "stationId": 7}
    part = {"partId": 1, "partData": tools.encode("Sizes", {"length": 45})}
    payload = {"timing": {"referenceTime": 1}, "parts": [part]}
    raw = bytes(tools.encode("CollectivePerceptionMessage", {"header": header, "payload": payload}))
    assert EtsiDecoder("etsi/cpm", OwnDefinitions((elsewhere, DICTIONARY))).stamp_near(raw, 0) is None


TYPES = """
Types DEFINITIONS AUTOMATIC TAGS ::= BEGIN
Free ::= INTEGER
Grows ::= INTEGER (-3..12, ...)
Spanned ::= INTEGER (2 | 7..11 | 4)
Named ::= SEQUENCE { k Kinds (unknown | car..tram | farm) }
Kinds ::= INTEGER { unknown(0), car(5), tram(11), farm(14) } (0..255)
Text ::= UTF8String (SIZE(1..20))
Ascii ::= IA5String (SIZE(0..9))
Digits ::= NumericString (SIZE(1..16))
Shown ::= VisibleString
Octets ::= OCTET STRING (SIZE(2..5))
Long ::= OCTET STRING
Flags ::= BIT STRING { a(0), b(2) } (SIZE(4))
Bits ::= BIT STRING
Many ::= SEQUENCE (SIZE(2..3, ...)) OF BOOLEAN
Default ::= SEQUENCE { a INTEGER (0..9) DEFAULT 4, b BOOLEAN OPTIONAL }
Either ::= CHOICE { a NULL, b-c BOOLEAN, ..., d INTEGER (0..3) }
END
"""


@pytest.mark.parametrize(
    ("name", "value", "seen"),
    [
        *(("Free", value, float(value)) for value in (0, -1, 127, 128, -129, 65536, -(2**40))),
        ("Free", 2**60, 2**60),
        *(("Grows", value, float(value)) for value in (-3, 12, 13, -200)),
        *(("Spanned", value, float(value)) for value in (2, 4, 11)),
        *(("Named", {"k": value}, {"k": float(value)}) for value in (0, 5, 11, 14)),
        ("Text", "Grüße", "Grüße"),
        ("Ascii", "", ""),
        ("Ascii", "a\x00b~", "a\x00b~"),
        ("Digits", "0 42", "0 42"),
        ("Shown", "x" * 300, "x" * 300),
        ("Octets", b"abc", b"abc"),
        *(("Long", bytes(range(256)) * size, bytes(range(256)) * size) for size in (0, 1, 63, 64, 65, 128, 200)),
        ("Flags", (b"\xa0", 4), ["a", "b"]),
        ("Flags", (b"\x50", 4), ["1", "3"]),
        ("Bits", (b"\xa0", 3), [True, False, True]),
        ("Bits", (b"", 0), []),
        ("Bits", (b"\x01" * 120, 960), ([False] * 7 + [True]) * 120),
        ("Many", [True] * 3, [True] * 3),
        ("Many", [True, False] * 100, [True, False] * 100),
        ("Default", {}, {"a": 4.0}),
        ("Default", {"a": 5, "b": False}, {"a": 5.0, "b": False}),
        ("Either", ("a", None), {"a": True}),
        ("Either", ("b-c", False), {"b_c": False}),
        ("Either", ("d", 3), {"d": 3.0}),
    ],
)
def test_every_kind_of_type_is_read_as_asn1tools_writes_it(name: str, value: Any, seen: Any) -> None:
    kind = OwnDefinitions((TYPES,)).type([name])
    assert kind is not None
    raw = encoder(TYPES).encode(name, value)
    assert Readers().reader(kind)(Bits(raw)) == seen


def test_a_list_of_elements_without_bits_cannot_be_longer_than_the_message_allows() -> None:
    text = "Bomb DEFINITIONS AUTOMATIC TAGS ::= BEGIN Bomb ::= SEQUENCE OF NULL END"
    kind = OwnDefinitions((text,)).type(["Bomb"])
    assert kind is not None
    with pytest.raises(DecodeError, match="more elements than its length allows"):
        Readers().reader(kind)(Bits(b"\xc4" * 1000))


def test_random_bytes_are_read_or_refused_for_every_kind_of_type() -> None:
    own, chance = OwnDefinitions((TYPES, PERCEPTION, DICTIONARY)), random.Random(1)
    names = [line.split()[0] for line in TYPES.splitlines() if "::=" in line][1:]
    for name in (*names, "CollectivePerceptionMessage"):
        kind = own.type([name])
        assert kind is not None
        read, refused = Readers().reader(kind), 0
        for _ in range(200):
            try:
                read(Bits(chance.randbytes(chance.randrange(40))))
            except DecodeError:
                refused += 1
        assert 0 < refused < 200 or name in ("Grows", "Named"), name


@pytest.mark.parametrize(
    ("modules", "problem"),
    [
        ([{"file": "missing.asn"}], r"spec.asn1\[0\].file: cannot read missing.asn: .*No such file"),
        (
            [{"definition": "X DEFINITIONS : BEGIN END"}],
            r"spec.asn1\[0\].definition: not valid ASN.1: .* at line 1, column 15",
        ),
        ([{"definition": PERCEPTION}], r"spec.asn1: the ASN.1 modules are incomplete: .*Dictionary"),
        ([], r"spec.streams\[0\].type: no package provides the ASN.1 definition of etsi/cpm: name the files"),
    ],
)
def test_errors_in_asn1_modules_are_reported_by_field(modules: list[dict[str, str]], problem: str) -> None:
    stream = {"name": "cpm", "key": "its/${client:*}/cpm", "encoding": "uper", "type": "etsi/cpm"}
    with pytest.raises(DetectorError, match=problem) as raised:
        stream_readers(a_detector(stream, asn1=modules))
    assert len(raised.value.problems) == 1


def test_modules_come_from_files_and_from_the_detector_itself(tmp_path: Path) -> None:
    file = tmp_path / "dictionary.asn"
    file.write_text(DICTIONARY)
    stream = {"name": "cpm", "key": "its/${client:*}/cpm", "encoding": "uper", "type": "etsi/cpm"}
    readers = stream_readers(a_detector(stream, asn1=[{"definition": PERCEPTION}, {"file": str(file)}]))
    assert readers.decoders["cpm"].decode(perception())["payload"]["parts"][0]["partData"] == {"length": 4.5}
