"""Services of ROS 2: type hashes as ROS computes them, requests and responses as CDR."""

from __future__ import annotations

from typing import Any

import pytest

from detector.actions.trigger.services import KNOWN, ServiceError, service
from detector.streams.codecs.definitions import Definition
from detector.streams.codecs.ros import standard, types_with


def test_type_hashes_match_those_of_ros() -> None:
    """Those of example_interfaces and std_srvs as their nodes announce them (rmw_zenoh's design, a foreign client)."""
    add = service("example_interfaces/srv/AddTwoInts", "int64 a\nint64 b\n---\nint64 sum\n", standard())
    assert add.type_hash == "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    trigger = service("std_srvs/srv/Trigger", None, standard())
    assert trigger.type_hash == "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"


@pytest.mark.parametrize("name", KNOWN)
def test_every_known_service_has_an_empty_request_and_reads_its_response(name: str) -> None:
    known = service(name, None, standard())
    request = known.request({})
    assert request[:2] == b"\x00\x01"
    read = known.store.deserialize_cdr(request, f"{name}_Request")
    assert bytes(known.store.serialize_cdr(read, f"{name}_Request")) == request


def test_a_request_carries_values_of_every_kind() -> None:
    definition = "float64[] x\nbuiltin_interfaces/Time t\nuint8[3] q\nstring[] n\nbool b\nint8 i\n---\nstring s\n"
    made = service("a/srv/B", definition, standard())
    values = {"x": [1, 2.5], "t": {"sec": 5.0}, "q": [1, 2, 255], "n": ["a", "ü"], "b": True, "i": -128}
    read: Any = made.store.deserialize_cdr(made.request(values), "a/srv/B_Request")
    assert (read.x.tolist(), read.t.sec, read.t.nanosec, read.q.tolist()) == ([1.0, 2.5], 5, 0, [1, 2, 255])
    assert (read.n, read.b, read.i) == (["a", "ü"], True, -128)
    assert made.response(b"\x00\x01\x00\x00\x03\x00\x00\x00ok\x00") == {"s": "ok"}


def test_a_definition_may_use_messages_of_the_detector() -> None:
    types = types_with((Definition("my/msg/Place", "string name\n"),))
    made = service("my/srv/Go", "Place where\n---\n", types)
    read: Any = made.store.deserialize_cdr(made.request({"where": {"name": "x"}}), "my/srv/Go_Request")
    assert read.where.name == "x"


@pytest.mark.parametrize(
    ("definition", "request_", "reported"),
    [
        ("int8 x\n---\n", {"x": 300}, r"request.x must be between -128 and 127 \(int8\); got 300"),
        ("int8 x\n---\n", {"y": 3}, "request.y is not a field of a/srv/B_Request: its fields are x"),
        ("int8 x\n---\n", {"x": 0.5}, "request.x must be of type int8; got 0.5"),
        ("string s\n---\n", {"s": 4}, "request.s must be of type string; got 4"),
        ("uint8[2] s\n---\n", {"s": [4]}, r"request.s must be a list of 2; got \[4\]"),
        (
            "builtin_interfaces/Time t\n---\n",
            {"t": 4},
            "request.t must be a map with the fields of builtin_interfaces/msg/Time; got 4",
        ),
        ("int8 x\n", {}, "must have exactly one line of ---, between request and response; got 0"),
        ("int8\n---\n", {}, "cannot read the request in the definition of a/srv/B: write a type and a name"),
        ("foo/Bar x\n---\n", {}, "x has the unknown type foo/msg/Bar: define it in spec.messages"),
        (None, {}, "unknown service type a/srv/B: give its .srv file as definition"),
    ],
)
def test_invalid_requests_are_reported_by_field(
    definition: str | None, request_: dict[str, Any], reported: str
) -> None:
    with pytest.raises(ServiceError, match=reported):
        service("a/srv/B", definition, standard()).request(request_)


def test_an_undecodable_response_is_reported() -> None:
    with pytest.raises(ServiceError, match="the response is not of type std_srvs/srv/Trigger"):
        service("std_srvs/srv/Trigger", None, standard()).response(b"\x00\x01\x00\x00\x01\xff\xff")
