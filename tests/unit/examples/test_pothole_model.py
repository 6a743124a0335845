"""The model of examples/pothole-detection is what its script trains, and separates what no threshold can."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np
import onnxruntime
import pytest

from tests.guides import ROOT

FOLDER = ROOT / "examples" / "pothole-detection"


@pytest.fixture(scope="module")
def training() -> Any:
    sys.path.insert(0, str(FOLDER))
    try:
        yield importlib.import_module("train")
    finally:
        sys.path.remove(str(FOLDER))


def test_the_model_file_matches_the_trained_weights_and_generalizes(training: Any) -> None:
    session = onnxruntime.InferenceSession(training.MODEL, providers=["CPUExecutionProvider"])
    samples, labels = training.windows(500, np.random.default_rng(training.SEED + 7))
    found = session.run(None, {"shaking": samples.astype(np.float32)})[0][:, 0]
    trained = training.answers(training.train(), samples)
    # Another processor rounds differently on the way; after 400 steps that is still the same answer.
    assert np.mean((found > 0.5) == (trained > 0.5)) > 0.99
    assert np.mean((found > 0.5) == (labels == 1)) > 0.98
    hardest = np.abs(samples).max(axis=1)
    by_threshold = max(np.mean((hardest > limit) == (labels == 1)) for limit in np.arange(0, 15, 0.1))
    assert by_threshold < 0.9
