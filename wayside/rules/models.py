"""Compiles signals that a model computes, from the rule and its Detector. The model file is checked elsewhere.

A model's inputs are signals of the same rule over streams; a model cannot be the input of a model.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

from wayside.api import Detector
from wayside.api.documents import FieldPath
from wayside.api.eventrule import EventRuleSpec, Signal
from wayside.api.model import ModelInput, ModelSource, ModelWindow
from wayside.rules.compiled import CompiledModel, CompiledSignal

_IMAGE = "sensor_msgs/msg/Image"
_POINTS = "sensor_msgs/msg/PointCloud2"

Located = tuple[FieldPath, str]
"""A field below the model, and its problem."""


class _Compiler(Protocol):
    """The rule that is being compiled, and the receiver of its problems."""

    @property
    def spec(self) -> EventRuleSpec:
        """Of the rule."""

    @property
    def detector(self) -> Detector:
        """That is to evaluate it."""

    def problem(self, path: FieldPath, message: str) -> None:
        """Report a problem with a field."""


def compile_models(rule: _Compiler, compiled: Sequence[CompiledSignal]) -> tuple[CompiledModel, ...]:
    """The rule's model signals; their files are not there yet. `compiled` has the signals over streams."""
    by_name = {signal.name: signal for signal in compiled}
    models = []
    for index, signal in enumerate(rule.spec.signals):
        if signal.model is None:
            continue
        for path, text in _problems(signal.model, rule.spec.signals, rule.detector):
            rule.problem(("spec", "signals", index, "model", *path), text)
        windows = {
            (given.name, name): _windowed(by_name[name], f"{signal.name}/{given.name}/{name}", rule.detector)
            for given in signal.model.inputs
            if given.window is not None
            for name in given.window.signals
            if name in by_name
        }
        models.append(CompiledModel(signal.name, index, signal.model, windows))
    return tuple(models)


def _problems(model: ModelSource, signals: Sequence[Signal], detector: Detector) -> Iterator[Located]:
    """The problems of the model's inputs; `signals` are all signals of the rule."""
    by_name = {signal.name: signal for signal in signals}
    for index, given in enumerate(model.inputs):
        at: FieldPath = ("inputs", index)
        if given.window is not None:
            yield from (
                ((*at, "window", *path), text) for path, text in _window_problems(given.window, by_name, detector)
            )
        elif given.signals:
            yield from (((*at, *path), text) for path, text in _signal_problems(given.signals, by_name))
        else:
            yield from (((*at, *path), text) for path, text in _stream_problems(given, detector))


def _windowed(signal: CompiledSignal, name: str, detector: Detector) -> CompiledSignal:
    """The signal's samples under a name of their own, as far back as they are kept."""
    stream = detector.spec.stream(signal.stream or "")
    kept = None if stream is None else detector.spec.buffer_duration_ns(stream)
    return replace(signal, name=name, over_ns=kept)


def _signal_problems(names: Iterable[str], by_name: Mapping[str, Signal]) -> Iterator[Located]:
    for position, name in enumerate(names):
        signal = by_name.get(name)
        if signal is None:
            known = ", ".join(each for each, other in by_name.items() if other.model is None) or "none"
            yield ("signals", position), f"the rule has no signal {name}; it has {known}"
        elif signal.model is not None:
            yield ("signals", position), f"{name} is computed by a model and cannot be the input of another model"
        elif signal.plugin is not None:
            yield ("signals", position), f"{name} is computed by a plugin and cannot be the input of a model"
        elif signal.is_derived:
            yield (
                ("signals", position),
                f"{name} is not computed from a stream and cannot be the input of a model",
            )


def _window_problems(window: ModelWindow, by_name: Mapping[str, Signal], detector: Detector) -> Iterator[Located]:
    wrong = dict(_signal_problems(window.signals, by_name))
    yield from wrong.items()
    for position, name in enumerate(window.signals):
        if ("signals", position) in wrong:
            continue
        signal = by_name[name]
        stream = None if signal.stream is None else detector.spec.stream(signal.stream)
        if signal.stream is None or signal.value is None:
            yield ("signals", position), f"a window needs values of a stream: {name} has no stream, or no value"
        elif stream is not None and window.over is not None:
            kept = detector.spec.buffer_duration_ns(stream)
            if window.over.ns >= kept:
                yield (
                    ("over",),
                    f"{window.over} is not shorter than the {kept / 1e9:g} s that Detector {detector.name} keeps of "
                    f"stream {stream.name}: shorten it, or raise the stream's buffer.duration",
                )


def _stream_problems(given: ModelInput, detector: Detector) -> Iterator[Located]:
    for field, source, wanted in (("image", given.image, _IMAGE), ("points", given.points, _POINTS)):
        if source is None:
            continue
        stream = detector.spec.stream(source.stream)
        if stream is None:
            names = ", ".join(each.name for each in detector.spec.streams)
            yield (field, "stream"), f"Detector {detector.name} has no stream {source.stream}; it has {names}"
        elif stream.type != wanted:
            yield (field, "stream"), f"stream {stream.name} has type {stream.type}: {wanted} is needed"
