"""`python -m tests.texts [FILE]`: write every text that a user may read into FILE, to be read in one go.

Four parts: the fields of the kinds, as `kubectl explain --recursive` prints them; the messages of log lines; the texts
of errors; all other texts (conditions, Kubernetes Events, findings, output); and the `--help` of each command.
Messages and texts are read from the source: `{…}` stands for a value. A text that occurs several times is
listed once, with all its places.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from wayside.api import KINDS
from wayside.api.schema import crd

ROOT = Path(__file__).parents[1]
PROGRAMS = ("detector", "application-manager")
FOLDERS = ("wayside", "detector", "application_manager")
LEVELS = {"debug", "info", "warning", "error", "exception", "critical", "log"}

_FILLED = re.compile(r"\{(?:[^{}]|\{[^{}]*\})*\}")
_CODE = re.compile(r"\(self\.|self\.\w+ (==|!=|in|\|\|) |=> |color-scheme|len\(|\w:\w+ \w+:|^<\w|</")


class Use(StrEnum):
    """The use of a text."""

    LOG = "Log messages"
    ERROR = "Errors"
    OTHER = "Conditions, Events, findings and output"


@dataclass(frozen=True)
class Text:
    """A text in the source, with the level of a log message or the class of an error."""

    use: Use
    sort: str
    text: str


def fields(schema: dict[str, Any], path: str, printed: dict[str, str]) -> Iterator[str]:
    """One line a field. A group of fields that was printed before is referred to, `printed` has where."""
    for name, field in sorted(schema.get("properties", {}).items()):
        inner, brackets = field, ""
        while "items" in inner or isinstance(inner.get("additionalProperties"), dict):
            brackets += "[]" if "items" in inner else "{}"
            inner = inner.get("items") or inner["additionalProperties"]
        place = f"{path}.{name}{brackets}".lstrip(".")
        described = " ".join(" ".join(each.get("description", "").split()) for each in _levels(field, inner)).strip()
        inside = inner.get("properties", {})
        first = printed.setdefault(repr(sorted(inside.items())), place) if len(inside) > 1 else place
        yield f"{place}: {described}" + (f" (fields: see {first})" if first != place else "")
        rules = [rule for each in _levels(field, inner) for rule in each.get("x-kubernetes-validations", ())]
        yield from (f"  refused with: {rule['message']}" for rule in rules if "message" in rule)
        if first == place:
            yield from fields(inner, place, printed)


def texts(tree: ast.AST) -> Iterator[tuple[int, Text]]:
    """The texts of a module, with their lines; docstrings, annotations and the help of options are left out."""
    seen: set[int] = set()
    for node in ast.walk(tree):
        if _silent(node):
            seen.update(id(each) for each in ast.walk(node))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and _is_log(node.func):
            yield from _of(node, Use.LOG, node.func.attr, seen)
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield from _of(node.exc, Use.ERROR, ast.unparse(node.exc.func), seen)
    yield from _of(tree, Use.OTHER, "", seen)


def commands(program: str, *names: str) -> Iterator[str]:
    """The help of a command and of all below it."""
    done = subprocess.run(
        [Path(sys.executable).with_name(program), *names, "--help"],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "TYPER_USE_RICH": "0"},
    )
    yield done.stdout
    for name in re.findall(r"^  ([a-z-]+)\b", done.stdout.partition("\nCommands:\n")[2], re.MULTILINE):
        yield from commands(program, *names, name)


def write(file: Any) -> None:
    """Write all texts into a text file that is open."""
    for kind in KINDS.values():
        schema = crd(kind)["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
        print(f"# {kind.__name__}: {schema['description']}\n", file=file)
        for line in fields({"properties": {each: schema["properties"][each] for each in ("spec", "status")}}, "", {}):
            print(line, file=file)
        print(file=file)
    found: dict[Text, list[str]] = {}
    for module in sorted(each for folder in FOLDERS for each in (ROOT / folder).rglob("*.py")):
        for number, text in texts(ast.parse(module.read_text(encoding="utf-8"))):
            found.setdefault(text, []).append(f"{module.relative_to(ROOT)}:{number}")
    for use in Use:
        print(f"# {use}\n", file=file)
        for text, places in found.items():
            if text.use is use:
                print(text.text, f"    {' '.join([text.sort, *places]).strip()}", sep="\n", file=file)
        print(file=file)
    for program in PROGRAMS:
        for printed in commands(program):
            print(printed, file=file)


def _levels(field: dict[str, Any], inner: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The schemas of a field and of the elements of its lists and maps."""
    yield from (field,) if inner is field else (field, inner)


def _is_log(function: ast.Attribute) -> bool:
    logger = ast.unparse(function.value).split(".")[-1]
    return function.attr in LEVELS and logger.strip("_").removesuffix("ger") in {"log", "warnings"}


def _silent(node: ast.AST) -> bool:
    """Whether a node holds no text for users: a docstring, an annotation's parts, or what help and CRDs print."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True
    if isinstance(node, ast.Subscript) and ast.unparse(node.value) in {"Annotated", "Literal"}:
        return True
    if not isinstance(node, ast.Call):
        return False
    return ast.unparse(node.func).split(".")[-1] in {"Field", "Option", "Argument", "Typer", "command", "compile"}


def _of(node: ast.AST, use: Use, sort: str, seen: set[int]) -> Iterator[tuple[int, Text]]:
    """The texts in an expression, each in one piece; those seen before are left out."""
    if id(node) in seen:
        return
    if isinstance(node, ast.Constant | ast.JoinedStr) or (isinstance(node, ast.BinOp) and _joins(node)):
        seen.update(id(each) for each in ast.walk(node))
        text = " ".join(_template(node).split())
        if _reads(text, use):
            yield getattr(node, "lineno", 0), Text(use, sort, text)
        return
    for child in ast.iter_child_nodes(node):
        yield from _of(child, use, sort, seen)


def _reads(text: str, use: Use) -> bool:
    """Whether a text is prose: two words; of literals that are neither logged nor raised, three."""
    plain = _FILLED.sub(" … ", text)
    words = re.findall(r"[A-Za-z]{2,}", plain)
    return len(words) >= 2 and (use is not Use.OTHER or (len(plain.split()) >= 3 and not _CODE.search(plain)))


def _joins(node: ast.BinOp) -> bool:
    """Whether the operation joins or fills a text."""
    return isinstance(node.op, ast.Add | ast.Mod) and any(
        isinstance(each, ast.JoinedStr)
        or (isinstance(each, ast.Constant) and isinstance(each.value, str))
        or (isinstance(each, ast.BinOp) and _joins(each))
        for each in (node.left, node.right)
    )


def _template(node: ast.AST) -> str:
    """A text as it is written, with `{…}` for each part that the program fills in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_template(each) for each in parts)
        case ast.FormattedValue(value=value):
            return f"{{{ast.unparse(value)}}}"
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _template(left) + _template(right)
        case ast.BinOp(left=left, op=ast.Mod()):
            return _template(left)
        case ast.Constant():
            return ""
    return f"{{{ast.unparse(node)}}}"


def main() -> int:
    """Write the file; the exit code."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "texts.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        write(file)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
