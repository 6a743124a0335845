"""The file of all texts has exactly the texts for users."""

from __future__ import annotations

import ast

from tests.texts import Text, Use, fields, texts

MODULE = '''
"""The docstring of a module is for developers."""

def join(host: str, port: int, tried: int) -> str:
    """And so is the docstring of a function."""
    log.warning("cannot reach %s;" " retrying: %s", host, port)
    if tried > 3:
        raise InputError(f"--connect {host!r}: no answer " f"within {tried} s: correct it")
    return "connected" if port else f"{host} has no port yet"
'''


def test_logs_errors_and_other_texts_are_found_in_one_piece_with_their_lines() -> None:
    assert sorted(texts(ast.parse(MODULE)), key=lambda each: each[0]) == [
        (6, Text(Use.LOG, "warning", "cannot reach %s; retrying: %s")),
        (8, Text(Use.ERROR, "InputError", "--connect {host}: no answer within {tried} s: correct it")),
        (9, Text(Use.OTHER, "", "{host} has no port yet")),
    ]


def test_a_group_of_fields_is_described_once() -> None:
    point = {"properties": {"x": {"description": "Metres east."}, "y": {"description": "Metres north."}}}
    schema = {
        "properties": {"from": {"description": "The start.", **point}, "to": {"description": "The end.", **point}}
    }
    assert [*fields(schema, "spec", {})] == [
        "spec.from: The start.",
        "spec.from.x: Metres east.",
        "spec.from.y: Metres north.",
        "spec.to: The end. (fields: see spec.from)",
    ]
