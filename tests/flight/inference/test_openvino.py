"""Networks that OpenVINO computes give what ONNX Runtime gives, within what 8 bits round by."""

from __future__ import annotations

import functools
import importlib.util
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import ModelError
from flockd.flight.inference import OnnxModel
from flockd.flight.inference.feeds import feeds_for
from flockd.flight.perception.onnx import OnnxNetworks

MODELS = Path(__file__).parents[3] / "models"


@functools.cache
def opened(name: str, provider: Any = "openvino") -> OnnxModel:
    return OnnxModel(MODELS / f"{name}.yaml", threads=1, provider=provider)


@pytest.mark.parametrize("name", ["neighbours", "flow", "detector"])
def test_in_float_it_gives_the_same(name: str) -> None:
    """Of another image size than the golden input's too, which it compiles for."""
    ours, theirs = opened(name), opened(name, "cpu")
    assert ours.provider == "OpenVINO"
    for size in ((640, 480), (480, 640)):
        feeds = feeds_for(ours.manifest, size)
        expected = theirs.run(feeds)
        for output, values in ours.run(feeds).items():
            np.testing.assert_allclose(values, expected[output], rtol=0, atol=2e-3 * np.abs(expected[output]).max())


@pytest.mark.parametrize("name", ["distance_int8", "verification_int8"])
def test_crops_stay_with_onnx_runtime(name: str) -> None:
    """They come in batches of any size, each of which OpenVINO would compile in flight."""
    assert opened(name).provider == "CPUExecutionProvider"


def test_a_run_can_be_ended_and_the_next_one_is_whole() -> None:
    model = opened("neighbours_int8")
    feeds = feeds_for(model.manifest, (640, 480))
    expected = model.run(feeds)
    ended: list[Exception] = []

    def run() -> None:
        try:
            while True:
                model.run(feeds)
        except Exception as error:  # noqa: BLE001 - OpenVINO's own
            ended.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    while thread.is_alive():
        model.terminate()
        time.sleep(0.001)
    assert len(ended) == 1
    for name, value in model.run(feeds).items():
        np.testing.assert_array_equal(value, expected[name])


def test_where_it_is_not_installed_one_sentence_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    config = PerceptionConfig.model_validate({"provider": "openvino"})
    with pytest.raises(ModelError, match=r"perception\.provider: .*; install flockd\[openvino\]"):
        OnnxNetworks(config, MODELS)
