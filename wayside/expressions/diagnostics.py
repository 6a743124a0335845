"""Turns CEL's compiler errors into errors with a position in the author's text and a remedy.

Errors of a failed evaluation become messages in the terms of the documentation.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Final

from wayside.expressions.errors import ExpressionError
from wayside.expressions.functions import FUNCTIONS
from wayside.expressions.lexer import TokenKind, tokens
from wayside.expressions.numbers import DIGITS, Rewritten
from wayside.names import did_you_mean

_ENTRY = re.compile(r"^(?:[A-Z_]+: )?ERROR: <input>:(-?\d+):(-?\d+): (.*)$", re.MULTILINE)
_UNDECLARED = re.compile(r"undeclared reference to '([^']*)'")
_OVERLOAD = re.compile(r"found no matching overload for '([^']*)' applied to '(.*)'")
_UNRECOGNISED = re.compile(r"token recognition error at: '(.*)'$")
_UNEXPECTED = re.compile(r"(?:mismatched|extraneous|no viable alternative at) input '(.*?)'(?: expecting .*)?$")
_MISSING = re.compile(r"missing '(.*?)' at ")

_WORDS = {
    "and": "in CEL, write `&&`",
    "or": "in CEL, write `||`",
    "not": "in CEL, write `!`",
    "AND": "in CEL, write `&&`",
    "OR": "in CEL, write `||`",
    "NOT": "in CEL, write `!`",
    "if": "in CEL, write `condition ? this : that`",
    "else": "in CEL, write `condition ? this : that`",
    "True": "in CEL, write `true`",
    "False": "in CEL, write `false`",
    "yes": "in CEL, write `true`",
    "no": "in CEL, write `false`",
    "None": "in CEL, write `null`",
    "nil": "in CEL, write `null`",
}
_SIGNS = {"=": "to compare, write `==`", "&": "in CEL, write `&&`", "|": "in CEL, write `||`", "'": "", '"': ""}
_QUOTE = (
    "a string is not closed, or YAML removed its quotes: put the whole expression in quotes, and use the other kind of "
    "quotes inside"
)
_DEPTH = "the maximum is 32 levels; each operator of a chain such as `a + b + c` adds one: use parentheses to group it"
EMPTY = "YAML interprets a leading `!`, `#` or quote itself: put the whole expression in quotes, as in '!braking'"


def diagnose(report: str, source: str, compiled: Rewritten, names: Collection[str]) -> ExpressionError:
    """The first error of CEL's report, with the further errors in its `others`."""
    errors: list[ExpressionError] = []
    lines = [0, *(match.end() for match in re.finditer("\n", compiled.text))]
    for line, column, text in _ENTRY.findall(report):
        start = lines[min(max(int(line), 1), len(lines)) - 1]
        offset = start + max(int(column), 1) - 1
        at = compiled.origin[offset] if offset < len(compiled.origin) else len(source)
        if source[at : at + 1] == "." and (undeclared := _UNDECLARED.search(text)):
            at = source.rfind(undeclared[1].split(".")[0], 0, at)  # for `x.y`, CEL reports the position of the dot
        message, hint = _explain(text.removesuffix("[INVALID_ARGUMENT]").strip(), source, at, names)
        errors.append(ExpressionError(message, source=source, offset=at, hint=hint))
    if not errors:
        message, hint = _explain(re.sub(r"^[A-Z_]+: | \[[A-Z_]+\]$", "", report), source, 0, names)
        return ExpressionError(message, source=source, hint=hint)
    errors.sort(key=lambda error: error.offset)
    errors[0].others = tuple(errors[1:])
    return errors[0]


def _explain(text: str, source: str, at: int, names: Collection[str]) -> tuple[str, str | None]:
    text = text.removeprefix("Syntax error: ")
    if match := _UNDECLARED.search(text):
        return _undeclared(match[1], source, at, names)
    if match := _OVERLOAD.search(text):
        return _overload("string" if match[1] == DIGITS else match[1], match[2])
    if match := _UNRECOGNISED.search(text):
        sign = match[1].strip()[:1]
        return f"unexpected `{sign}`", _SIGNS[sign] or _QUOTE if sign in _SIGNS else None
    if match := _UNEXPECTED.search(text):
        if match[1] == "<EOF>":
            return "the expression is incomplete", _stray_sign(source)
        word = next((token.text for token in tokens(source) if token.start <= at < token.end), match[1])
        return f"unexpected `{word}`", _WORDS.get(word) or _after(source, at) or _stray_sign(source)
    if "recursion" in text:
        return "the expression is nested too deeply", _DEPTH
    if match := _MISSING.search(text):
        return f"missing `{match[1]}`", None
    return text, None


def _undeclared(name: str, source: str, at: int, names: Collection[str]) -> tuple[str, str | None]:
    name = name.removeprefix(".").split(".")[0]
    if _is_call(source, at, name):
        if name in FUNCTIONS:
            return f"wrong number of arguments for `{name}`", _takes(name)
        return f"there is no function `{name}`", did_you_mean(name, FUNCTIONS, "`") or None
    message = f"`{name}` is not declared here"
    if name in _WORDS:
        return message, _WORDS[name]
    if similar := did_you_mean(name, names, "`"):
        return message, similar
    known = ", ".join(f"`{each}`" for each in sorted(names)[:12]) or "nothing"
    return message, f"declared: {known}; a string needs its own quotes inside those of YAML: '\"{name}\"'"


def _overload(function: str, arguments: str) -> tuple[str, str | None]:
    operator = function.replace("_", "").replace("@", "") if function.startswith(("_", "-", "!", "@")) else function
    message = f"`{operator}` does not take {arguments}"
    if operator in FUNCTIONS:
        return message, _takes(operator)
    if operator == "%":
        return message, "`%` takes only integers: write double(int(a) % int(b))"
    if "double" in arguments and re.search(r"\bu?int\b", arguments):
        return message, "numbers are doubles here: wrap the integer, as in double(int(x))"
    if operator in ("&&", "||", "!"):
        return message, "it takes booleans"
    if operator == "?:":
        return message, "it takes a boolean and two values of the same type"
    return message, None


def _takes(function: str) -> str:
    known = FUNCTIONS[function]
    return f"it takes {known.usage()}: {known.types()}"


def _is_call(source: str, at: int, name: str) -> bool:
    """CEL reports the position of the bracket for an unresolved call, and that of the name otherwise."""
    return source[at : at + 1] == "(" or source[at : at + len(name) + 1] == f"{name}("


def _after(source: str, at: int) -> str | None:
    """The remedy for an error caused by the token before: CEL parses `not` as a name, and reports the next token."""
    before = [token for token in tokens(source) if token.end <= at and token.kind is not TokenKind.SPACE]
    if not before:
        return None
    if before[-1].kind in (TokenKind.INT, TokenKind.FLOAT):
        return "remove the unit: numbers are in metres, seconds and radians"
    return _WORDS.get(before[-1].text)


def _stray_sign(source: str) -> str | None:
    for token in tokens(source):
        if token.kind is TokenKind.OTHER and token.text in _SIGNS:
            return _SIGNS[token.text] or _QUOTE
    return None


# Errors of a failed evaluation

_NO_MEMBERS: Final = "cannot read a field of a value without fields"
NO_MEMBERS: Final = frozenset({_NO_MEMBERS})
"""The messages of `clean` for reading a member of a number, a string or a list."""

_ABSENT = ("no value for ", "no key ", "no index ")
_NO_OVERLOAD: Final = re.compile(r"^\w+: No matching overloads found : (.*)$")
_CALL: Final = re.compile(r"^([^(]+)\((.*)\)$")
_OF_A_FIELD: Final = re.compile(r"\b(at|seen)_(\w+)")
_WRITTEN: Final = {"at": "at", "seen": "seenFrom"}
_COMPARISONS: Final = frozenset({"<", "<=", ">", ">="})
_NAMES: Final = {"[]": "[…]", "?:": "? :"}
_OF_BYTES: Final = "byteCount, checksum, allZero, numberAt or utf8"
_CLEANING: Final = (
    (re.compile(r'^\w+: No value with name "(.*)" found in Activation$'), r"no value for `\1`"),
    (re.compile(r"^\w+: Key not found in map : (.*)$"), r"no key \1 in the map"),
    (re.compile(r"^\w+: Index error: index=(.*) size=(.*)$"), r"no index \1 in the list"),
    (re.compile(r"^(?:\w+: )?Applying SELECT to non-message type.*$"), _NO_MEMBERS),
    (re.compile(r"^[A-Z_]+: (.*?)(?: \[[A-Z_]+\])?$", re.DOTALL), r"\1"),
)
_TYPES: Final = {
    "double": "number",
    "string": "string",
    "bool": "boolean",
    "int64": "integer beyond 2^53",
    "uint64": "list, map or bytes",  # a handle
    "null_type": "null",
}


def clean(message: str) -> str:
    """The message without CEL's codes, in the terms of the documentation."""
    message = _OF_A_FIELD.sub(lambda found: f"{_WRITTEN[found[1]]}(…).{found[2]}", message)
    overload = _NO_OVERLOAD.search(message)
    if overload is not None:
        return _no_overload(overload[1])
    for pattern, replacement in _CLEANING:
        if pattern.search(message):
            return pattern.sub(replacement, message)
    return message


def reports_absent(message: str) -> bool:
    """Whether a clean message reports an absent value."""
    return message.startswith(_ABSENT)


def _no_overload(operation: str) -> str:
    """The message for wrong argument types: for a Wayside function, the types that it takes and those given.

    For an operation of CEL on bytes, it names the functions to use instead.
    """
    if operation.startswith(f"{DIGITS}("):
        operation = operation.replace(DIGITS, "string", 1)
    call = _CALL.search(operation)
    if call is not None and (function := FUNCTIONS.get(call[1])) is not None:
        given = ", ".join(_TYPES.get(kind, kind) for kind in call[2].split(", "))
        return f"{function.usage()} takes {function.types()}; got {given}"
    if call is None:
        return f"the operation does not take these types: {operation}"
    name = call[1].replace("_", "").lstrip("@") if not call[1].isalpha() else call[1]
    kinds = [_a(kind) for kind in call[2].split(", ")]
    if name in _COMPARISONS:
        text = f"`{name}` cannot compare {kinds[0]} with {kinds[1]}"
    else:
        text = f"`{_NAMES.get(name, name)}` does not take {' and '.join(kinds)}"
    return f"{text}: for bytes, use {_OF_BYTES}" if "uint64" in operation else text


def _a(kind: str) -> str:
    """The type with its article."""
    name = _TYPES.get(kind, kind)
    return name if name == "null" else f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
