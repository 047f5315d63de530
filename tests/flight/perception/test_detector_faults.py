"""What a picture loses where the shipped detector lies or fails."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from flockd.core.config.perception import DetectionParameters, PerceptionConfig
from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference import OnnxModel
from flockd.ground.pictures.single_frame import PictureDetector, PictureResult
from tests.flight.perception.cameras import rendered

SIZE = (480, 352)


@functools.cache
def detector() -> PictureDetector:
    return PictureDetector(PerceptionConfig(threads=1))


def seen(image: UInt8Array) -> PictureResult:
    return detector().detect(image, fov_deg=90.0)


def answering(monkeypatch: pytest.MonkeyPatch, probability: float, width_px: float) -> None:
    """Every cell of the detector's maps says so of a drone; not a number: it fails."""
    infer = OnnxModel.infer

    def lie(model: OnnxModel, contents: dict[str, object]) -> dict[str, Float32Array]:
        outputs = infer(model, contents)  # type: ignore[arg-type]
        if model.manifest.name != "detector":
            return outputs
        if np.isnan(probability):
            raise FloatingPointError("model detector: output boxes is not finite")
        boxes = outputs["boxes"].copy()
        boxes[..., 2:5] = (width_px, width_px / 2, probability)
        return {**outputs, "boxes": boxes}

    monkeypatch.setattr(OnnxModel, "infer", lie)


@pytest.mark.parametrize("width_px", [7.0, 100.0])
def test_a_detector_that_sees_drones_everywhere_is_contradicted_and_costs_no_more_than_the_limit(
    monkeypatch: pytest.MonkeyPatch, width_px: float
) -> None:
    answering(monkeypatch, 0.999, width_px)
    result = seen(rendered(240.0, SIZE).rgb)
    assert result.proposals == DetectionParameters().max_proposals
    assert result.detections == ()


def test_one_that_sees_none_leaves_the_drone_to_the_segmentation_and_one_that_fails_costs_the_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = rendered(240.0, SIZE, (3.0, 0.3, -4.4)).rgb
    answering(monkeypatch, 0.0, 20.0)
    assert len(seen(image).detections) == 1
    answering(monkeypatch, np.nan, 20.0)
    result = seen(image)
    assert (result.detections, result.proposals) == ((), 0)
    assert not np.any(result.mask)
