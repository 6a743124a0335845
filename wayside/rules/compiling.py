"""Compiles a rule against the Detector that evaluates it, and reports all problems of the rule."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from functools import lru_cache

from wayside.api import Detector, EventRule
from wayside.api.base import JsonValue, Metadata, PositiveDuration
from wayside.api.detector import BufferLimits, DetectorSpec
from wayside.api.documents import FieldPath
from wayside.api.eventrule import Samples, Signal
from wayside.api.stream import Stream
from wayside.expressions import CelType
from wayside.expressions.expanding import POSITION
from wayside.rules.actions import canonical_json, compile_actions, compile_deploys
from wayside.rules.compiled import CompiledPlugin, CompiledRule, CompiledSignal, episode_stream
from wayside.rules.compiler import Compiler
from wayside.rules.derived import compile_derived, statistics_read
from wayside.rules.fields import Fields, unknown_fields
from wayside.rules.models import compile_models
from wayside.rules.places import NO_MORE_IS_KNOWN, KnownPlaces, own_places
from wayside.rules.problems import RuleError, RuleProblem
from wayside.rules.scopes import check_models, compile_elements, compile_subject, with_closing_speed, with_signals
from wayside.rules.variables import END_MEMBERS, EPISODE_MEMBERS, condition_environment, element_of, signal_name_problem


def compile_rule(
    rule: EventRule,
    detector: Detector,
    fields: Mapping[str, Fields] | None = None,
    known: Iterable[RuleProblem] = (),
    places: KnownPlaces | None = None,
) -> CompiledRule:
    """The rule in the form that the engine evaluates.

    `fields` has the message fields of the streams whose fields are all known: reading another field is a problem.
    `known` has problems that were already found between several rules. `places` are the places that the rule can
    name; None: those that the Detector itself defines, and any other name if it has maps.

    Raises:
        RuleError: with every problem of the rule.
    """
    compiler = Compiler(rule, detector, fields or {}, places or own_places(detector))
    compiler.problems += known
    compiled = _compiled(compiler)
    if compiler.problems or compiled is None:
        raise RuleError(compiler.problems)
    return compiled


def _compiled(compiler: Compiler) -> CompiledRule | None:
    """The compiled rule; None if it has problems."""
    spec = compiler.spec
    subject = compile_subject(compiler)
    elements = compile_elements(compiler, spec.each)
    signals = [_signal(compiler, index, signal) for index, signal in enumerate(spec.signals)]
    models = compile_models(compiler, [signal for signal in signals if signal is not None])
    plugins = [(each.name, each.plugin) for each in spec.signals if each.plugin is not None]
    if spec.evaluation.on_sample is not None:
        compiler.stream(("spec", "evaluation", "onSample"), spec.evaluation.on_sample)
    environment = condition_environment(spec)
    derived = compile_derived(compiler, environment)
    when = compiler.condition(("spec", "when"), spec.when, environment)
    until = compiler.condition(("spec", "until"), spec.until, environment)
    for field, condition in (("when", when), ("until", until)):
        for text in () if condition is None else statistics_read(condition, derived):
            compiler.problem(("spec", field), text)
    deploys = compile_deploys(compiler, environment)
    actions = compile_actions(compiler, environment)
    elements = with_signals(elements, element_of(spec), [each for each in signals if each is not None])
    check_models(compiler, elements, models)
    if subject is not None:
        templates = [deploy.parameters for deploy in deploys]
        templates += [template for action in actions for template in action.templates.values()]
        embedded = [each.expression for template in templates for each in template.embedded]
        subject = with_closing_speed(compiler, subject, (when, until, *(each.of for each in derived), *embedded))
    if compiler.problems or subject is None or when is None:
        return None
    return CompiledRule(
        name=compiler.rule.name,
        subject=subject,
        signals=tuple(signal for signal in signals if signal is not None),
        plugins=tuple(CompiledPlugin(name, plugin.name, plugin.parameters) for name, plugin in plugins),
        when=when,
        until=until,
        every_ns=spec.evaluation.period_ns,
        for_ns=spec.for_.ns,
        cooldown_ns=spec.cooldown.ns,
        unknown_timeout_ns=(spec.unknown_timeout or compiler.detector.spec.client_timeout).ns,
        enabled=spec.enabled,
        dry_run=spec.dry_run,
        deploys=tuple(deploys),
        actions=tuple(actions),
        classification=None if spec.classification is None else spec.classification.to_json(),
        digest=_digest(compiler),
        places=tuple(compiler.used.values()),
        elements=elements,
        parameters=compiler.parameters,
        models=models,
        derived=derived,
        has_margin=spec.margin is not None,
        on_sample=spec.evaluation.on_sample,
        on_demand=bool(spec.evaluation.on_demand),
        priority=spec.evaluation.priority,
        maximum_per_hour=spec.max_episodes_per_hour,
    )


def _signal(compiler: Compiler, index: int, signal: Signal) -> CompiledSignal | None:
    at: FieldPath = ("spec", "signals", index)
    if (problem := signal_name_problem(signal.name, compiler.spec)) is not None:
        compiler.problem((*at, "name"), problem)
    if signal.rule_name is not None:
        return _episode_signal(compiler, at, signal, signal.rule_name)
    if signal.stream is None:
        return None  # computed by a model, by a plugin, or from other signals
    stream = compiler.stream((*at, "stream"), signal.stream)
    value = compiler.sample((*at, "value"), signal.value, stream, CelType.DYN, element_of(compiler.spec))
    where = compiler.sample((*at, "where"), signal.where, stream, CelType.BOOL, element_of(compiler.spec))
    over = None if signal.over is None else signal.over.ns
    only = None if stream is None or stream.names_by_message else stream.client
    if only is not None and signal.client not in (None, only):
        compiler.problem((*at, "client"), f"stream {signal.stream} has only the client {only}: write client: {only}")
    if stream is not None and over is not None and over > compiler.retention_ns(stream):
        compiler.exceeds_retention((*at, "over"), f"{signal.over} is longer than", stream)
    return CompiledSignal(
        signal.name, signal.stream, signal.aggregate, value, where, over, compiler.parameters,
        quantile=signal.quantile, client=signal.client,
    )  # fmt: skip


def _episode_signal(compiler: Compiler, at: FieldPath, signal: Signal, rule: str) -> CompiledSignal:
    """A signal whose samples are the episode starts or ends of another rule."""
    ends = signal.samples is Samples.ENDS
    value, where = (
        compiler.sample((*at, field), source, None, kind, element_of(compiler.spec), of_rule=True)
        for field, source, kind in (("value", signal.value, CelType.DYN), ("where", signal.where, CelType.BOOL))
    )
    for field, expression in (("value", value), ("where", where)):
        members = END_MEMBERS if ends else EPISODE_MEMBERS
        for text in () if expression is None else unknown_fields(expression.paths, "msg", members):
            compiler.problem((*at, field), f"{text} (msg is an episode's {'end' if ends else 'start'})")
    over = None if signal.over is None else signal.over.ns
    return CompiledSignal(
        signal.name, episode_stream(rule, ends=ends), signal.aggregate, value, where, over, compiler.parameters, rule,
        quantile=signal.quantile, client=signal.client,
    )  # fmt: skip


def _digest(compiler: Compiler) -> str:
    """The digest of everything that defines the rule's episodes, including the Detector's parameters and places."""
    rule, clients = compiler.rule, compiler.detector.spec.clients
    decisive: list[JsonValue] = [
        rule.semantics(),
        {client.name: values for client in clients if (values := client.parameters.get(rule.name))},
    ]
    if compiler.used or rule is not compiler.written:
        decisive.append(sorted(shape.key for shape in compiler.used.values()))
    decisive += [
        {stream.name: dict(stream.position.axes)}
        for stream in compiler.detector.spec.streams
        if stream.position is not None and any(POSITION in each for each in _of_stream(compiler.written, stream.name))
    ]
    return hashlib.sha256(canonical_json(decisive).encode()).hexdigest()[:16]


def _of_stream(rule: EventRule, stream: str) -> list[str]:
    """The expressions of the rule's signals over the stream."""
    signals = (signal for signal in rule.spec.signals if signal.stream == stream)
    return [each for signal in signals for each in (signal.value, signal.where) if each is not None]


def own_problems(rule: EventRule) -> tuple[RuleProblem, ...]:
    """The problems of a rule that do not depend on a Detector; none if some Detector could evaluate it.

    The rule is compiled against a Detector that has every stream, keeps everything and supports every action. So the
    remaining problems are those of the rule itself, and no change of a Detector can solve them.
    """
    try:
        compile_rule(rule, _taking_everything(), places=NO_MORE_IS_KNOWN)
    except RuleError as error:
        # The type and the messages of a stream depend on the Detector; those here are made up.
        return tuple(each for each in error.problems if each.path[-1:] != ("stream",))
    return ()


class _AllStreams(DetectorSpec):
    """A Detector's spec with a stream of every name."""

    def stream(self, name: str) -> Stream | None:
        return self.streams[0].model_copy(update={"name": name, "items": "msg"})  # so that rules may read item


@lru_cache(maxsize=1)
def _taking_everything() -> Detector:
    raw = {
        "streams": [{"name": "any", "key": "${client:*}/any", "encoding": "json"}],
        "recordings": {"path": "/recordings"},
        "database": {"uriVariable": "WAYSIDE_DATABASE", "files": {"path": "/files"}},
    }
    spec = _AllStreams.model_validate(raw).model_copy(
        update={"buffer": BufferLimits(duration=PositiveDuration("999999h"))}
    )
    return Detector.model_construct(kind="Detector", metadata=Metadata(name="any"), spec=spec)
