"""Binds the models of a compiled rule to their files, and reports mismatches: file, inputs, shapes, outputs."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.onnx.loading import ModelError, ModelFile, Tensor, load_model
from detector.streams.codecs.tensors import gray, image, points
from wayside.api.documents import FieldPath
from wayside.api.model import Channels, ImageLayout, ModelImage, ModelInput, ModelPoints
from wayside.rules import CompiledModel, CompiledRule, RuleError, RuleProblem

MAXIMUM_OUTPUT = 4096
"""Maximum number of values in a model's output for one client: expressions stop after about ten thousand steps."""


def bind_models(rule: CompiledRule) -> CompiledRule:
    """The rule with its models ready to run; another file changes the rule's identity.

    Raises:
        RuleError: with every problem of the models.
    """
    if not rule.models:
        return rule
    problems: list[RuleProblem] = []
    bound: list[CompiledModel] = []
    for model in rule.models:
        at: FieldPath = ("spec", "signals", model.index, "model")
        try:
            file = load_model(model.source.file)
        except ModelError as error:
            problems.append(RuleProblem((*at, "file"), str(error)))
            continue
        found = [RuleProblem((*at, *path), text) for path, text in _problems(model, file)]
        problems += found
        if not found:
            bound.append(replace(model, runner=Runner(model, file)))
    if problems:
        raise RuleError(problems)
    hashes = "".join(model.runner.sha256 for model in bound if model.runner is not None)
    digest = hashlib.sha256((rule.digest + hashes).encode()).hexdigest()[:16]
    return replace(rule, models=tuple(bound), digest=digest)


class Runner:
    """Runs one model signal of a rule."""

    def __init__(self, model: CompiledModel, file: ModelFile) -> None:
        self.sha256 = file.sha256
        self._file = file
        self._output = model.source.output
        self._given = {each.name: each for each in model.source.inputs}
        self._kinds = {each.name: each.dtype for each in file.inputs if each.name in self._given}

    def tensor(self, name: str, payload: bytes) -> NDArray[Any]:
        """The message of a camera or lidar as that input. Raises DecodeError."""
        given = self._given[name]
        return _image(given.image, payload) if given.image is not None else _points(_known(given.points), payload)

    def run(self, rows: Sequence[Mapping[str, Any]]) -> list[Any]:
        """The signal's value for each row of inputs: a double, a list of doubles, or a map of these by output.

        Raises:
            ValueError: the model fails.
        """
        cast = [
            {name: np.asarray(value).astype(self._kinds[name]).reshape(self._given[name].shape)
             for name, value in row.items()}
            for row in rows
        ]  # fmt: skip
        outputs = self._file.run_rows(cast)
        names = [self._output] if self._output is not None else list(outputs)
        columns = {name: outputs[name].astype(np.float64) for name in names}
        if any(len(column) != len(rows) for column in columns.values()):
            raise ModelError(f"the model must return {len(rows)} rows for {len(rows)} clients")
        if len(names) == 1:
            return [_plain(columns[names[0]][row]) for row in range(len(rows))]
        return [{name: _plain(columns[name][row]) for name in names} for row in range(len(rows))]


def _problems(model: CompiledModel, file: ModelFile) -> Iterator[tuple[FieldPath, str]]:
    source = model.source
    if source.sha256 is not None and source.sha256 != file.sha256:
        yield ("sha256",), f"the sha256 of the file is {file.sha256}: give that value, or the right file"
    declared = {each.name: each for each in file.inputs}
    for index, given in enumerate(source.inputs):
        if given.name not in declared:
            yield (
                ("inputs", index, "name"),
                f"the model has no input {given.name}; its inputs are {_listed(file.inputs)}",
            )
            continue
        if text := _misfit(given, declared[given.name]):
            yield ("inputs", index), text
    missing = sorted(declared.keys() - {given.name for given in source.inputs})
    if missing:
        yield ("inputs",), f"the model also needs the inputs {', '.join(missing)}"
    outputs = {each.name: each for each in file.outputs}
    if source.output is not None and source.output not in outputs:
        yield ("output",), f"the model has no output {source.output}; its outputs are {_listed(file.outputs)}"
        return
    wanted = [outputs[source.output]] if source.output is not None else list(file.outputs)
    for tensor in wanted:
        if tensor.dtype is None:
            yield ("output",), f"output {tensor.name} is {tensor.kind}, not a tensor of numbers: name another output"
            return
    fitting = [each for each in source.inputs if each.name in declared and not _misfit(each, declared[each.name])]
    if len(fitting) == len(source.inputs) and not missing:
        yield from _trial(source.inputs, file, wanted)


def _trial(inputs: Sequence[ModelInput], file: ModelFile, wanted: Sequence[Tensor]) -> Iterator[tuple[FieldPath, str]]:
    """Runs the model once on zeros, for two clients, or for as many as it takes at a time."""
    dtypes = {each.name: each.dtype for each in file.inputs}
    row = {given.name: np.zeros(given.shape, dtypes[given.name]) for given in inputs}
    try:
        outputs = file.run_rows([row, row])
    except ModelError as error:
        yield ("inputs",), f"{error} (in a trial with zeros for two clients)"
        return
    for tensor in wanted:
        shape = outputs[tensor.name].shape
        if not shape or shape[0] != 2:
            text = f"output {tensor.name} has shape {list(shape)} for two clients: its first axis must be the clients"
            yield ("output",), text
        elif (size := int(np.prod(shape[1:]))) > MAXIMUM_OUTPUT:
            yield ("output",), f"output {tensor.name} has {size} numbers per client; the maximum is {MAXIMUM_OUTPUT}"


def _misfit(given: ModelInput, declared: Tensor) -> str:
    """Why the input does not fit the model's; empty if it does."""
    if declared.dtype is None:
        return f"input {declared.name} is {declared.kind}: only tensors of numbers are supported"
    if len(declared.shape) < 2:
        return f"input {declared.name} has shape {_shape(declared.shape)}: its first axis must be the clients"
    first, rest = declared.shape[0], declared.shape[1:]
    if first not in (None, 1):
        return (
            f"input {declared.name} has shape {_shape(declared.shape)}, for exactly {first} clients: export "
            "the model with a first axis of variable length"
        )
    fits = len(rest) == len(given.shape) and all(
        want in (None, have) for want, have in zip(rest, given.shape, strict=False)
    )
    if fits:
        return ""
    return f"the input of a client has shape {_shape(given.shape)}, but {declared.name} requires {_shape(rest)}"


def _image(wanted: ModelImage, payload: bytes) -> NDArray[np.float32]:
    pixels = image(payload)
    if wanted.channels is Channels.GRAY:
        pixels = gray(pixels)
    elif pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    elif wanted.channels is Channels.BGR:
        pixels = pixels[:, :, ::-1]
    height, width = pixels.shape[:2]
    if (height, width) != (wanted.height, wanted.width):
        rows = np.arange(wanted.height) * height // wanted.height
        columns = np.arange(wanted.width) * width // wanted.width
        pixels = pixels[rows][:, columns]
    mean, std = np.array(wanted.mean or [0.0], np.float32), np.array(wanted.std or [1.0], np.float32)
    scaled: NDArray[np.float32] = (pixels * np.float32(wanted.scale) - mean) / std
    return scaled.transpose(2, 0, 1) if wanted.layout is ImageLayout.CHW else scaled


def _points(wanted: ModelPoints, payload: bytes) -> NDArray[np.float64]:
    found = points(payload, wanted.fields)
    if wanted.scale:
        found = found * np.array(wanted.scale)
    if len(found) > wanted.count:
        return found[np.arange(wanted.count) * len(found) // wanted.count]
    return np.concatenate([found, np.zeros((wanted.count - len(found), len(wanted.fields)))])


def _known(wanted: ModelPoints | None) -> ModelPoints:
    assert wanted is not None  # noqa: S101  the engine requests only images and points
    return wanted


def _plain(value: NDArray[np.float64]) -> Any:
    """A double for a single number, otherwise lists of them."""
    return float(value.reshape(())) if value.size == 1 else value.tolist()


def _listed(tensors: Sequence[Tensor]) -> str:
    return ", ".join(f"{each.name} {_shape(each.shape)}" for each in tensors) or "none"


def _shape(shape: Sequence[int | None]) -> str:
    return "[" + ", ".join("any" if length is None else str(length) for length in shape) + "]"
