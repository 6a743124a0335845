"""A model file: read, identified by its sha256, and run the same way each time.

It uses one thread and does not choose kernels at run time: the same inputs give the same outputs, live and in a replay.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

_NUMBERS: Mapping[str, str] = {
    "tensor(float16)": "float16",
    "tensor(float)": "float32",
    "tensor(double)": "float64",
    "tensor(bool)": "bool",
    **{f"tensor({sign}int{bits})": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
"""numpy's names of ONNX's numeric types."""

_loaded: WeakValueDictionary[str, ModelFile] = WeakValueDictionary()
"""By sha256, the models in use: a change of another rule does not reload them."""

_MAXIMUM_BYTES = 2**31
"""ONNX stores models in one protobuf message, which cannot be larger."""


class ModelError(ValueError):
    """A model file that cannot be used; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input or output as declared in the file."""

    name: str
    kind: str
    """ONNX's type, e.g. tensor(float)."""
    shape: tuple[int | None, ...]
    """Including the first axis, which is the clients; None: any length."""

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """numpy's type; None if the tensor contains no numbers."""
        return np.dtype(_NUMBERS[self.kind]) if self.kind in _NUMBERS else None


class ModelFile:
    """A model ready to run."""

    def __init__(self, content: bytes, sha256: str) -> None:
        """Raises ModelError: onnxruntime is not installed, or cannot read the content."""
        try:
            import onnxruntime  # noqa: PLC0415  an extra, and half a second to import
        except ImportError:
            raise ModelError("onnxruntime is not installed: pip install 'wayside[onnx]'") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.use_deterministic_compute = True
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common base
            raise ModelError(f"is not a valid ONNX model: {_line(error)}") from error
        self.sha256 = sha256
        self.inputs = tuple(map(_tensor, self._session.get_inputs()))
        self.outputs = tuple(map(_tensor, self._session.get_outputs()))

    @property
    def one_by_one(self) -> bool:
        """Whether the first axis has length 1: the model takes one client at a time."""
        return any(each.shape[:1] == (1,) for each in self.inputs)

    def run(self, inputs: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The outputs by name. Raises ModelError if the model fails on these inputs."""
        names = [each.name for each in self.outputs]
        try:
            return dict(zip(names, self._session.run(names, dict(inputs)), strict=True))
        except Exception as error:  # as above
            raise ModelError(f"the model failed: {_line(error)}") from error

    def run_rows(self, rows: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        """The outputs by name, with the rows along the first axis. Raises ModelError."""
        if not self.one_by_one:
            return self.run({name: np.stack([row[name] for row in rows]) for name in rows[0]})
        runs = [self.run({name: array[None] for name, array in row.items()}) for row in rows]
        return {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}


def load_model(path: str) -> ModelFile:
    """The model of a file. An unchanged file is not loaded again.

    Raises:
        ModelError: the file does not exist, or is not a model.
    """
    try:
        size = Path(path).stat().st_size
        if size > _MAXIMUM_BYTES:
            raise ModelError(f"{path} has {size} bytes; an ONNX model may have at most {_MAXIMUM_BYTES}")
        content = Path(path).read_bytes()
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}: is the volume mounted?") from error
    sha256 = hashlib.sha256(content).hexdigest()
    model = _loaded.get(sha256)
    if model is None:
        try:
            model = _loaded[sha256] = ModelFile(content, sha256)
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
    return model


def _tensor(described: Any) -> Tensor:
    shape = tuple(length if isinstance(length, int) and length >= 0 else None for length in described.shape or ())
    return Tensor(described.name, described.type, shape)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
