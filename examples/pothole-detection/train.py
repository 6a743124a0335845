"""Trains the model that finds potholes: run this file, and it writes pothole.onnx beside itself.

The model is a convolution over a second of shaking (eight shapes of eleven samples), the best match of each shape, and
a logistic regression over these. The data is generated and seeded, with another seed than the scenario's; windows that
cut a pothole are left out, since either answer would be right.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from shaking import RATE_HZ, Samples, add, asphalt, cobbles, pothole, speed_bump

SEED = 1
WINDOWS, STEPS, RATE = 3000, 400, 0.03
SHAPES, LONG = 8, 11
MODEL = Path(__file__).with_name("pothole.onnx")

Array = NDArray[np.float64]


def windows(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Windows of a second, of shape [count, 50], and for each whether a pothole is in it (1) or not (0)."""
    rows, labels = [], []
    for index in range(count):
        road = _road(rng)
        if index % 2:
            add(road, pothole(rng), int(rng.integers(1, RATE_HZ - 9)))
        rows.append(road)
        labels.append(float(index % 2))
    return np.array(rows), np.array(labels)


def _road(rng: np.random.Generator) -> Samples:
    road = asphalt(RATE_HZ, rng)
    if rng.random() < 0.3:
        road += cobbles(RATE_HZ, rng)
    if rng.random() < 0.5:  # perhaps only its end, or its beginning
        bump, start = speed_bump(rng), int(rng.integers(-25, RATE_HZ))
        add(road, bump[max(0, -start) :], max(0, start))
    return road


def train(seed: int = SEED) -> dict[str, Array]:
    """The weights: `shapes` [8, 11], `offsets` [8], `weights` [8] and `bias` []."""
    rng = np.random.default_rng(seed)
    samples, labels = windows(WINDOWS, rng)
    pieces = sliding_window_view(samples, LONG, axis=1)  # [windows, places, samples]
    model = {
        "shapes": rng.normal(0, 0.2, (SHAPES, LONG)), "offsets": np.zeros(SHAPES),
        "weights": rng.normal(0, 0.3, SHAPES), "bias": np.zeros(()),
    }  # fmt: skip
    first = {name: np.zeros_like(value) for name, value in model.items()}
    second = {name: np.zeros_like(value) for name, value in model.items()}
    for step in range(1, STEPS + 1):
        for name, slope in _slopes(model, pieces, labels).items():  # Adam
            first[name] = 0.9 * first[name] + 0.1 * slope
            second[name] = 0.999 * second[name] + 0.001 * slope**2
            size = np.sqrt(second[name] / (1 - 0.999**step)) + 1e-8
            model[name] = model[name] - RATE * first[name] / (1 - 0.9**step) / size
    return model


def _slopes(model: dict[str, Array], pieces: Array, labels: Array) -> dict[str, Array]:
    """Of the mean cross-entropy, by weight."""
    matches = pieces @ model["shapes"].T + model["offsets"]
    places = matches.argmax(axis=1)
    rows = np.arange(len(pieces))[:, None]
    best = np.maximum(matches[rows, places, np.arange(SHAPES)], 0)
    error = (_logistic(best @ model["weights"] + model["bias"]) - labels) / len(labels)
    back = error[:, None] * model["weights"] * (best > 0)
    return {
        "shapes": np.einsum("ns,nsl->sl", back, pieces[rows, places]), "offsets": back.sum(axis=0),
        "weights": best.T @ error, "bias": np.asarray(error.sum()),
    }  # fmt: skip


def _logistic(x: Array) -> Array:
    return 1 / (1 + np.exp(-np.clip(x, -30, 30)))


def answers(model: dict[str, Array], samples: Array) -> Array:
    """The probability of a pothole in each window, which the model must compute."""
    matches = sliding_window_view(samples, LONG, axis=1) @ model["shapes"].T + model["offsets"]
    return _logistic(np.maximum(matches, 0).max(axis=1) @ model["weights"] + model["bias"])


def save(model: dict[str, Array], path: Path) -> None:
    """Write it as ONNX: `shaking` [clients, 50] to `pothole` [clients, 1]."""
    constants = {
        "axes": np.array([1]), "shapes": np.float32(model["shapes"][:, None, :]),
        "offsets": np.float32(model["offsets"]), "weights": np.float32(model["weights"][:, None]),
        "bias": np.array([model["bias"]], dtype=np.float32),
    }  # fmt: skip
    nodes = [
        helper.make_node("Unsqueeze", ["shaking", "axes"], ["signal"]),
        helper.make_node("Conv", ["signal", "shapes", "offsets"], ["matches"]),
        helper.make_node("Relu", ["matches"], ["positive"]),
        helper.make_node("GlobalMaxPool", ["positive"], ["best"]),
        helper.make_node("Flatten", ["best"], ["flat"]),
        helper.make_node("Gemm", ["flat", "weights", "bias"], ["sum"]),
        helper.make_node("Sigmoid", ["sum"], ["pothole"]),
    ]
    graph = helper.make_graph(
        nodes,
        "pothole",
        [helper.make_tensor_value_info("shaking", TensorProto.FLOAT, ["clients", RATE_HZ])],
        [helper.make_tensor_value_info("pothole", TensorProto.FLOAT, ["clients", 1])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(made)
    path.write_bytes(made.SerializeToString())


def right(model: dict[str, Array], seed: int) -> float:
    """The share of windows of another seed that are classified correctly."""
    samples, labels = windows(1000, np.random.default_rng(seed))
    return float(np.mean((answers(model, samples) > 0.5) == (labels == 1)))


if __name__ == "__main__":
    trained = train()
    save(trained, MODEL)
    print(f"{MODEL.name}: {right(trained, SEED + 1):.1%} of 1000 other windows are classified correctly")
