"""Compiles actions: their templates, and the windows of samples for actions other than deploy."""

from __future__ import annotations

import json
from collections.abc import Iterable

from wayside.api.actions.action import ActionSpec
from wayside.api.actions.database import DatabaseAction
from wayside.api.actions.deploy import Deploy
from wayside.api.actions.window import Window, WindowClients
from wayside.api.detector import DetectorSpec
from wayside.api.stream import Stream
from wayside.api.validation_errors import FieldPath
from wayside.expressions import Environment, compile_template
from wayside.rules.compiled import CompiledAction, CompiledDeploy, CompiledWindow
from wayside.rules.compiler import Compiler


def compile_deploys(compiler: Compiler, environment: Environment) -> list[CompiledDeploy]:
    """The rule's deploy actions."""
    found = (
        _deploy(compiler, ("spec", "actions", index, "deploy", "parameters"), action.name, action.deploy, environment)
        for index, action in enumerate(compiler.spec.actions)
        if action.deploy is not None
    )
    return [each for each in found if each is not None]


def compile_actions(compiler: Compiler, environment: Environment) -> list[CompiledAction]:
    """The rule's actions other than deploy."""
    return [
        _compiled(compiler, ("spec", "actions", index), action, environment)
        for index, action in enumerate(compiler.spec.actions)
        if action.deploy is None
    ]


def canonical_json(value: object) -> str:
    """JSON in a canonical form: equal values give equal texts."""
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
    }  # one by one, so that one value that cannot be rendered does not affect the others
    if action.database is not None:
        _check_database(compiler, (*at, "database"), action.database)
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
        if window.before.ns and back > compiler.retention_ns(stream) and not stream.latched:
            with_for = f" plus the rule's for ({compiler.spec.for_})" if compiler.spec.for_.ns else ""
            compiler.exceeds_retention((*at, "before"), f"{window.before}{with_for} exceeds", stream)
    everyone = window.clients is WindowClients.ALL or compiler.spec.scope.fleet is not None
    clients = None if everyone else frozenset(window.with_clients)
    return window_of(spec, streams, clients, window.before.ns, window.after.ns)


def window_of(
    spec: DetectorSpec, streams: Iterable[Stream], clients: frozenset[str] | None, before_ns: int = 0, after_ns: int = 0
) -> CompiledWindow:
    """The window of these streams; it includes all latched streams."""
    return CompiledWindow(
        frozenset(stream.name for stream in streams if not stream.latched),
        frozenset(stream.name for stream in spec.streams if stream.latched),
        frozenset(stream.name for stream in spec.streams if stream.latched and _of_one(stream)),
        clients,
        before_ns,
        after_ns,
    )


def _of_one(stream: Stream) -> bool:
    """Whether all its samples belong to one client, which the Detector names."""
    return stream.client is not None and not stream.names_by_message


def _check_database(compiler: Compiler, at: FieldPath, action: DatabaseAction) -> None:
    """Report missing fields of the Detector."""
    detector = compiler.detector
    if detector.spec.database is None:
        compiler.problem(
            at, f"Detector {detector.name} has no spec.database: add it, e.g. {{uriVariable: MONGODB_URI}}"
        )
    elif action.files is not None and detector.spec.database.files is None:
        compiler.problem(
            (*at, "files"),
            f"Detector {detector.name} has no spec.database.files: add it with a path, or remove files",
        )
