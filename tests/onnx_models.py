"""Small ONNX models for tests, made when they are needed: exact arithmetic, so that their results are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT


def saved(
    path: Path,
    inputs: dict[str, Sequence[Any]],
    outputs: dict[str, Sequence[Any]],
    nodes: Sequence[onnx.NodeProto],
    constants: dict[str, Any] | None = None,
    *,
    kind: int = FLOAT,
) -> Path:
    """Write a model; shapes have the first axis, a name where it may be of any length."""
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(np.array(value), name) for name, value in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def weighted(path: Path, weights: Sequence[float], bias: float = 0.0, *, clients: Any = "n") -> Path:
    """risk = x · weights + bias, for x of shape [clients, len(weights)]; risk has shape [clients, 1]."""
    constants = {"w": np.float32(weights).reshape(-1, 1), "b": np.float32([bias])}
    nodes = [helper.make_node("MatMul", ["x", "w"], ["m"]), helper.make_node("Add", ["m", "b"], ["risk"])]
    return saved(path, {"x": [clients, len(weights)]}, {"risk": [clients, 1]}, nodes, constants)


def mean_of(path: Path, shape: Sequence[int]) -> Path:
    """value = the mean over all axes but the clients', of x with that shape for each."""
    axes = list(range(1, len(shape) + 1))
    node = helper.make_node("ReduceMean", ["x"], ["value"], axes=axes, keepdims=0)
    return saved(path, {"x": ["n", *shape]}, {"value": ["n"]}, [node])


def same(path: Path, shape: Sequence[int]) -> Path:
    """y = x, of that shape for each client."""
    return saved(path, {"x": ["n", *shape]}, {"y": ["n", *shape]}, [helper.make_node("Identity", ["x"], ["y"])])


def two_outputs(path: Path) -> Path:
    """low = x - 1 and high = x + 1, each of shape [n, 2]."""
    nodes = [helper.make_node("Sub", ["x", "one"], ["low"]), helper.make_node("Add", ["x", "one"], ["high"])]
    shape = ["n", 2]
    return saved(path, {"x": shape}, {"low": shape, "high": shape}, nodes, {"one": np.float32(1)})
