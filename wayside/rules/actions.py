"""Compiles actions: their templates, and the windows of samples of those other than deploy."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Protocol

from wayside.api import Detector
from wayside.api.actions.action import ActionSpec
from wayside.api.actions.database import DatabaseAction
from wayside.api.actions.deploy import Deploy
from wayside.api.actions.window import Window, WindowClients
from wayside.api.base import JsonValue
from wayside.api.detector import DetectorSpec
from wayside.api.eventrule import EventRuleSpec
from wayside.api.stream import Stream
from wayside.api.wording import FieldPath
from wayside.expressions import CompiledTemplate, Environment, compile_template
from wayside.rules.compiled import CompiledAction, CompiledDeploy, CompiledWindow


class Compiler(Protocol):
    """The parts of the rule's compiler that are used here."""

    detector: Detector
    spec: EventRuleSpec

    def template(
        self, path: FieldPath, value: Mapping[str, JsonValue], environment: Environment
    ) -> CompiledTemplate | None:
        """Texts with ${…}; None where one is wrong."""

    def stream(self, path: FieldPath, name: str) -> Stream | None:
        """The Detector's stream of that name; None, and a problem, where it has none."""

    def kept_ns(self, stream: Stream) -> int:
        """How long the Detector keeps the stream's samples, in nanoseconds."""

    def problem(self, path: FieldPath, message: str) -> None:
        """Report a problem with a field."""


def compile_deploys(
    compiler: Compiler, actions: Iterable[tuple[int, ActionSpec]], environment: Environment
) -> list[CompiledDeploy]:
    """The deploy actions among these, which have their places; problems are reported to the compiler."""
    found = (
        _deploy(compiler, ("spec", "actions", index, "deploy", "parameters"), action.name, action.deploy, environment)
        for index, action in actions
        if action.deploy is not None
    )
    return [each for each in found if each is not None]


def compile_actions(
    compiler: Compiler, actions: Iterable[tuple[int, ActionSpec]], environment: Environment
) -> list[CompiledAction]:
    """The actions other than deploy among these, which have their places; problems are reported to the compiler."""
    return [
        _compiled(compiler, ("spec", "actions", index), action, environment)
        for index, action in actions
        if action.deploy is None
    ]


def canonical_json(value: object) -> str:
    """JSON that is the same for the same value."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def _deploy(
    compiler: Compiler, at: FieldPath, action: str, deploy: Deploy, environment: Environment
) -> CompiledDeploy | None:
    parameters = compiler.template(at, dict(deploy.parameters), environment)
    if parameters is None:
        return None
    one_by_one = {
        name: compile_template(value, environment, path=name)
        for name, value in deploy.parameters.items()
        if deploy.follow
    }
    source = canonical_json(deploy.parameters)
    return CompiledDeploy(
        action, deploy.template_name, deploy.priority, source, parameters, deploy.follow, one_by_one, deploy.operation
    )


def _compiled(compiler: Compiler, at: FieldPath, action: ActionSpec, environment: Environment) -> CompiledAction:
    if action.record is not None and compiler.detector.spec.recordings is None:
        compiler.problem(
            (*at, "record"),
            f"Detector {compiler.detector.name} has no spec.recordings: add it, "
            "e.g. {path: /var/lib/wayside/recordings}",
        )
    below, values = action.templates
    rendered = {
        name: compiler.template((*at, *below), {name: value}, environment) for name, value in values.items()
    }  # one by one: what cannot be rendered takes nothing else with it
    if action.database is not None:
        for path, text in _database_problems(action.database, compiler.detector):
            compiler.problem((*at, *path), text)
    window = action.window
    return CompiledAction(
        action.name,
        {name: template for name, template in rendered.items() if template is not None},
        None if window is None else _window(compiler, (*at, action.field), action, window),
        canonical_json(action.to_json()),
    )


def _window(compiler: Compiler, at: FieldPath, action: ActionSpec, window: Window) -> CompiledWindow:
    if action.plugin is not None:
        at = (*at, "window")
    spec = compiler.detector.spec
    if window.streams is None:
        streams = list(spec.streams)
    else:
        named = (compiler.stream((*at, "streams", index), name) for index, name in enumerate(window.streams))
        streams = [stream for stream in named if stream is not None]
    back = window.before.ns + compiler.spec.for_.ns
    for stream in streams:
        kept = compiler.kept_ns(stream)
        if window.before.ns and back > kept and not stream.latched:
            with_for = f" plus the rule's for ({compiler.spec.for_})" if compiler.spec.for_.ns else ""
            compiler.problem(
                (*at, "before"),
                f"{window.before}{with_for} exceeds the {kept / 1e9:g} s that Detector "
                f"{compiler.detector.name} keeps of stream {stream.name}: shorten it, or raise the stream's "
                "buffer.duration",
            )
    everyone = window.clients is WindowClients.ALL or compiler.spec.scope.fleet is not None
    clients = None if everyone else frozenset(window.with_clients)
    return window_of(spec, streams, clients, window.before.ns, window.after.ns)


def window_of(
    spec: DetectorSpec, streams: Iterable[Stream], clients: frozenset[str] | None, before_ns: int = 0, after_ns: int = 0
) -> CompiledWindow:
    """The window of these streams; of the latched ones all come with it."""
    return CompiledWindow(
        frozenset(stream.name for stream in streams if not stream.latched),
        frozenset(stream.name for stream in spec.streams if stream.latched),
        frozenset(stream.name for stream in spec.streams if stream.latched and _of_one(stream)),
        clients,
        before_ns,
        after_ns,
    )


def _of_one(stream: Stream) -> bool:
    """Whether all its samples belong to a client named by the Detector."""
    return stream.client is not None and not stream.names_by_message


def _database_problems(action: DatabaseAction, detector: Detector) -> Iterator[tuple[FieldPath, str]]:
    """The missing fields; the paths begin at the action."""
    database = detector.spec.database
    if database is None:
        yield (
            ("database",),
            f"Detector {detector.name} has no spec.database: add it, e.g. {{uriVariable: MONGODB_URI}}",
        )
    elif action.files is not None and database.files is None:
        yield (
            ("database", "files"),
            f"Detector {detector.name} has no spec.database.files: add it with a path, or remove files",
        )
