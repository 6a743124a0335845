"""Parses YAML files into kinds. Every error names the file, the line, the field and the remedy."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from wayside.api import API_VERSION, KINDS
from wayside.api.base import Kind
from wayside.api.schema import field_names_at
from wayside.api.validation_errors import FieldPath, field_text, messages
from wayside.findings import ignored_by
from wayside.inputerror import InputError

__all__ = ["Document", "DocumentError", "FieldPath", "Problem", "field_text", "load_documents", "parse_object"]

_MEANINGFUL = frozenset("\"'![]{}&*%@`|>#,?")
"""The first characters that have a special meaning in YAML."""

_DEEPEST = 100
_MOST_FIELDS = 200_000
"""No real object comes near this number. YAML aliases that multiply themselves exceed it."""

MAXIMUM_BYTES = 256 * 1024
"""The maximum size of the spec of a template, rule or detector as JSON: the manager keeps these specs in memory."""

_BOUNDED = ("ApplicationTemplate", "Detector", "EventRule")  # tasks and instances have bounds for their parameters

_TOO_DEEP = f"is nested more than {_DEEPEST} levels deep: flatten it, and check for a YAML alias that refers to itself"

_YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem at a position in a file."""

    file: str
    line: int
    column: int
    field: str
    message: str
    check: str = ""
    """The name of the check that found it; empty if the file cannot be read, or an object is invalid."""

    def __str__(self) -> str:
        return self._text("")

    def as_warning(self) -> str:
        """The text of a warning."""
        return self._text("warning: ")

    def _text(self, severity: str) -> str:
        where = f"{self.file}:{self.line}:{self.column}: " if self.line else f"{self.file}: "
        return where + severity + (f"{self.field}: " if self.field else "") + self.message


class DocumentError(InputError):
    """Files that cannot be used; `problems` has every problem."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = tuple(problems)


@dataclass(frozen=True, slots=True)
class Document:
    """One object of a file, with the positions of its fields."""

    object: Kind
    file: str
    marks: dict[FieldPath, tuple[int, int]] = field(repr=False, compare=False)

    @property
    def line(self) -> int:
        """The line on which the object begins."""
        return self.marks.get((), (1, 1))[0]

    def ignores(self, check: str) -> bool:
        """Whether the object's annotation excludes the warnings of this name."""
        return check in ignored_by(self.object.metadata.annotations)

    def problem(self, path: FieldPath, message: str, check: str = "") -> Problem:
        """A problem at a field, e.g. ("spec", "signals", 0, "value"), or at its closest existing ancestor."""
        line, column = _mark(self.marks, path)
        return Problem(self.file, line, column, field_text(path), message, check)


def load_documents(paths: Iterable[str | Path]) -> list[Document]:
    """Read all objects of the files (a folder stands for its *.yaml, *.yml and *.json files).

    Raises:
        DocumentError: with every problem of every file: it cannot be read or is not YAML, or an object is not of
            Wayside's kinds or has invalid fields.
    """
    documents: list[Document] = []
    problems: list[Problem] = []
    for file in _files(paths, problems):
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
            problems.append(Problem(str(file), 0, 0, "", f"cannot be read: {reason}"))
            continue
        for node in _nodes(text, str(file), problems):
            document = _document(node, str(file), problems)
            if document is not None:
                documents.append(document)
    if problems:
        raise DocumentError(problems)
    return documents


def parse_object(raw: dict[str, Any]) -> Kind:
    """An object from the API server as its kind.

    Raises:
        ValueError: it is not of Wayside's kinds, is too large, or has invalid fields; the text names each field.
    """
    kind = _kind_of(raw)
    if problem := _size_problem(kind, raw):
        raise ValueError(f"spec: {problem}")
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        raise ValueError(
            "; ".join(
                f"{field_text(path)}: {message}"
                for path, message in messages(error, raw, partial(field_names_at, kind))
            )
        ) from None


def _size_problem(kind: type[Kind], raw: dict[str, Any]) -> str:
    """Why the spec is too large or too deep to be read; empty if it is neither."""
    if kind.__name__ not in _BOUNDED:
        return ""
    try:
        size = len(json.dumps(raw.get("spec"), ensure_ascii=False, separators=(",", ":"), default=str).encode())
    except RecursionError:
        return "is nested too deeply: flatten it"
    if size <= MAXIMUM_BYTES:
        return ""
    return f"must have at most {MAXIMUM_BYTES} bytes as JSON; got {size}: move data into files, ConfigMaps or charts"


def _files(paths: Iterable[str | Path], problems: list[Problem]) -> Iterator[Path]:
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(child for child in path.iterdir() if child.suffix in (".yaml", ".yml", ".json"))
            if not inside:
                problems.append(Problem(str(path), 0, 0, "", "the folder contains no .yaml, .yml or .json file"))
            yield from inside
        elif path.exists():
            yield path
        else:
            problems.append(Problem(str(path), 0, 0, "", "there is no such file: check the path"))


def _nodes(text: str, file: str, problems: list[Problem]) -> Iterator[yaml.Node]:
    try:
        for node in yaml.compose_all(text, Loader=_YAML_LOADER):
            if node is not None and not (isinstance(node, yaml.ScalarNode) and node.value == ""):
                yield node
    except yaml.MarkedYAMLError as error:
        lines = text.splitlines()
        mark = error.problem_mark or error.context_mark
        if error.context_mark and mark and mark.line >= len(lines):
            mark = error.context_mark  # detected at the end of the file: report the start of the unclosed part
        line, column = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        source = lines[line - 1] if 0 < line <= len(lines) else ""
        problems.append(Problem(file, line, column, "", f"is not YAML: {error.problem}; {_remedy(source, column)}"))
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n") + 1, error.position - before.rfind("\n")
        reason = f"contains the character {text[error.position]!r}, which YAML does not allow: remove it"
        problems.append(Problem(file, line, column, "", reason))
    except RecursionError:
        problems.append(Problem(file, 0, 0, "", _TOO_DEEP))


def _remedy(line: str, column: int) -> str:
    """The remedy for a line that is not YAML: mostly, an expression with special characters that needs quotes."""
    _, _, value = line.partition(": ")
    value = value.strip()
    if line[: column + 1].strip(" ").startswith("\t"):
        return "indent with spaces, not with tabs"
    if line.lstrip(" -").startswith("{") or value.startswith("{"):
        return "inside {…} and […], quote each string that contains a bracket, a brace, a comma, or `: `"
    if value[:1] in _MEANINGFUL or ": " in value:
        quoted = value.replace("'", "''")
        return f"an expression with special characters of YAML must be quoted as a whole: '{quoted}'"
    return "check the indentation and the quotes here and on the line above"


def _document(node: yaml.Node, file: str, problems: list[Problem]) -> Document | None:
    marks: dict[FieldPath, tuple[int, int]] = {}
    try:
        raw = _value(node, (), marks)
    except _TagError as error:
        problems.append(Problem(file, *error.mark, field_text(error.path), error.message))
        return None
    try:
        if not isinstance(raw, dict):
            raise ValueError(f"must be an object with apiVersion, kind, metadata and spec; got {raw!r}")
        kind = _kind_of(raw)
    except ValueError as error:
        problems.append(Problem(file, *_mark(marks, ()), "", str(error)))
        return None
    if problem := _size_problem(kind, raw):
        problems.append(Problem(file, *_mark(marks, ("spec",)), "spec", problem))
        return None
    try:
        return Document(kind.model_validate(raw), file, marks)
    except ValidationError as error:
        for path, message in messages(error, raw, partial(field_names_at, kind)):
            problems.append(Problem(file, *_mark(marks, path), field_text(path), message))
        return None


def _kind_of(raw: dict[str, Any]) -> type[Kind]:
    kind = KINDS.get(str(raw.get("kind")))
    if raw.get("apiVersion") != API_VERSION or kind is None:
        raise ValueError(
            f"must have apiVersion {API_VERSION} and one of the kinds {', '.join(KINDS)}; "
            f"got apiVersion {raw.get('apiVersion')!r}, kind {raw.get('kind')!r}"
        )
    return kind


class _TagError(Exception):
    def __init__(self, path: FieldPath, mark: tuple[int, int], message: str) -> None:
        super().__init__(message)
        self.path, self.mark, self.message = path, mark, message


def _value(node: yaml.Node, path: FieldPath, marks: dict[FieldPath, tuple[int, int]]) -> Any:
    """The node as plain Python; records the position of each field."""
    mark = (node.start_mark.line + 1, node.start_mark.column + 1)
    marks[path] = mark
    if len(path) > _DEEPEST:
        raise _TagError(path[:3], mark, _TOO_DEEP)
    if len(marks) > _MOST_FIELDS:
        raise _TagError(
            path[:3],
            mark,
            f"the object must have at most {_MOST_FIELDS} fields: remove YAML aliases, which multiply fields",
        )
    if node.tag.startswith("!"):
        written = f"{node.tag} {node.value}".strip() if isinstance(node, yaml.ScalarNode) else node.tag
        raise _TagError(path, mark, f"YAML reads {node.tag} as a tag: quote the expression, '{written}'")
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, child in node.value:
            key = str(key_node.value)
            if key in result:
                key_mark = (key_node.start_mark.line + 1, key_node.start_mark.column + 1)
                raise _TagError((*path, key), key_mark, "is given twice: remove one")
            result[key] = _value(child, (*path, key), marks)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_value(child, (*path, index), marks) for index, child in enumerate(node.value)]
    if node.tag == "tag:yaml.org,2002:timestamp":
        return node.value  # times stay text
    try:
        return yaml.SafeLoader("").construct_object(node)
    except (ValueError, yaml.YAMLError):
        name = node.tag.removeprefix("tag:yaml.org,2002:")
        raise _TagError(path, mark, f"YAML cannot read {node.value!r} as {name}: put it in quotes") from None


def _mark(marks: dict[FieldPath, tuple[int, int]], path: FieldPath) -> tuple[int, int]:
    while path and path not in marks:
        path = path[:-1]
    return marks.get(path, (1, 1))
