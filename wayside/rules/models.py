"""Compiles signals that a model computes, from the rule and its Detector. The model file is checked elsewhere.

A model's inputs are signals of the same rule over streams. A model cannot be the input of a model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from wayside.api import Detector
from wayside.api.documents import FieldPath
from wayside.api.eventrule import Signal
from wayside.api.model import ModelInput, ModelWindow
from wayside.rules.compiled import CompiledModel, CompiledSignal
from wayside.rules.compiler import Compiler

_IMAGE = "sensor_msgs/msg/Image"
_POINTS = "sensor_msgs/msg/PointCloud2"


def compile_models(compiler: Compiler, compiled: Sequence[CompiledSignal]) -> tuple[CompiledModel, ...]:
    """The rule's model signals, without their files. `compiled` has the signals over streams."""
    by_name = {signal.name: signal for signal in compiled}
    models = []
    for index, signal in enumerate(compiler.spec.signals):
        if signal.model is None:
            continue
        for place, given in enumerate(signal.model.inputs):
            _check(compiler, ("spec", "signals", index, "model", "inputs", place), given)
        windows = {
            (given.name, name): _windowed(by_name[name], f"{signal.name}/{given.name}/{name}", compiler.detector)
            for given in signal.model.inputs
            if given.window is not None
            for name in given.window.signals
            if name in by_name
        }
        models.append(CompiledModel(signal.name, index, signal.model, windows))
    return tuple(models)


def _windowed(signal: CompiledSignal, name: str, detector: Detector) -> CompiledSignal:
    """The signal's samples under their own name, as far back as the Detector keeps them."""
    stream = detector.spec.stream(signal.stream or "")
    kept = None if stream is None else detector.spec.buffer_duration_ns(stream)
    return replace(signal, name=name, over_ns=kept)


def _check(compiler: Compiler, at: FieldPath, given: ModelInput) -> None:
    """Report the problems of an input."""
    if given.window is not None:
        _check_window(compiler, (*at, "window"), given.window)
    elif given.signals:
        _usable(compiler, (*at, "signals"), given.signals)
    for field, source, wanted in (("image", given.image, _IMAGE), ("points", given.points, _POINTS)):
        stream = None if source is None else compiler.stream((*at, field, "stream"), source.stream)
        if stream is not None and stream.type != wanted:
            compiler.problem(
                (*at, field, "stream"),
                f"the type of stream {stream.name} must be {wanted}; got {stream.type or 'no type'}",
            )


def _usable(compiler: Compiler, at: FieldPath, names: Sequence[str]) -> list[tuple[FieldPath, Signal]]:
    """The signals of these names that can be inputs of a model, with their paths. Each other name is a problem."""
    by_name = {signal.name: signal for signal in compiler.spec.signals}
    found = []
    for position, name in enumerate(names):
        signal = by_name.get(name)
        if signal is None:
            known = ", ".join(each for each, other in by_name.items() if other.model is None) or "none"
            problem = f"the rule has no signal {name}; it has {known}"
        elif signal.model is not None:
            problem = f"{name} is computed by a model and cannot be the input of another model: remove it"
        elif signal.plugin is not None:
            problem = f"{name} is computed by a plugin and cannot be the input of a model: remove it"
        elif signal.is_derived:
            problem = f"{name} is not computed from a stream and cannot be the input of a model: remove it"
        else:
            found.append(((*at, position), signal))
            continue
        compiler.problem((*at, position), problem)
    return found


def _check_window(compiler: Compiler, at: FieldPath, window: ModelWindow) -> None:
    for path, signal in _usable(compiler, (*at, "signals"), window.signals):
        if signal.stream is None or signal.value is None:
            compiler.problem(
                path, f"{signal.name} must have a stream and a value, since the window consists of its values"
            )
            continue
        stream = compiler.detector.spec.stream(signal.stream)
        if stream is not None and window.over is not None and window.over.ns >= compiler.retention_ns(stream):
            compiler.exceeds_retention((*at, "over"), f"{window.over} is not shorter than", stream)
