"""The verification network beside the distance network: what it adds, and what it leaves alone."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.core.messages import Float32Array
from flockd.flight.inference import OnnxModel
from flockd.flight.perception import Crop, OnnxNetworks
from flockd.flight.perception.maps import RangeEstimate
from tests.flight.perception.cameras import crop_of, rendered

MODELS = data_path("models")


def crops() -> list[Crop]:
    """A drone before the sky, one before the ground, and ground alone."""
    taken = []
    for down_m, shown in ((-0.25, True), (0.35, True), (0.8, False)):
        pitch, _ = cv2.Rodrigues(np.array([0.0, -math.atan2(down_m, 1.5), 0.0]))
        view = rendered(100.0, (96, 96), *[(1.5, 0.0, -4.0 + down_m)] * shown, turned=np.asarray(pitch))
        taken.append(crop_of(view.rgb, 100.0))
    return taken


def ranges(models: Path = MODELS, **names: str) -> tuple[RangeEstimate, ...]:
    return OnnxNetworks(PerceptionConfig.model_validate({"flow": "dis", **names}), models).ranges(crops())


def logit(estimate: RangeEstimate) -> float:
    p = estimate.drone_probability
    return math.log(p / (1.0 - p))


def test_a_drone_keeps_the_range_that_the_distance_network_gives_and_what_is_none_gets_no_range() -> None:
    with_it, without = ranges(), ranges(verification="none")
    for ours, theirs in zip(with_it[:2], without[:2], strict=True):
        assert ours.drone_probability > 0.9
        assert (ours.log_range, ours.log_range_sigma, ours.size_m) == pytest.approx(
            (theirs.log_range, theirs.log_range_sigma, theirs.size_m), rel=1e-5
        )
    assert with_it[2].drone_probability <= 0.2, "the least for another crop"
    assert math.isnan(with_it[2].log_range)


@pytest.mark.parametrize(("detector", "says"), [("none", "verification"), ("detector", "detector")])
def test_the_distance_networks_logit_is_added_up_to_the_limit(copies: Path, detector: str, says: str) -> None:
    manifest = copies / f"{says}.yaml"
    names = {"distance": "distance", "verification": "verification", "detector": detector}
    judge = copies / "verification.yaml"
    judge.write_text(judge.read_text("utf-8").replace("another_crop_probability: 0.2", "another_crop_probability: 0.0"))
    shipped = manifest.read_text(encoding="utf-8")

    def limited(limit: float) -> list[float]:
        document = yaml.safe_load(shipped)
        document["thresholds"]["distance_logit_limit"] = limit
        manifest.write_text(yaml.safe_dump(document), encoding="utf-8")
        return [logit(one) for one in ranges(copies, **names)]

    alone = [logit(one) for one in ranges(verification="none", distance="distance")]
    for limit in (0.5, 1.0):
        added = np.subtract(limited(limit), limited(0.0))
        assert added == pytest.approx(np.clip(alone, -limit, limit), abs=1e-3)
    assert min(alone[:2]) > 1.0
    assert alone[2] < -1.0


def test_what_is_known_of_a_crop_before_is_added_to_what_it_shows() -> None:
    networks = OnnxNetworks(PerceptionConfig(flow="dis"), MODELS)
    ground = crops()[2]
    before, doubted, believed = networks.ranges([replace(ground, evidence=e) for e in (0.0, -1.5, 30.0)])
    assert logit(doubted) == pytest.approx(logit(before) - 1.5, abs=1e-3)
    assert math.isnan(before.log_range)
    assert math.isfinite(believed.log_range), "what is believed is asked for its range"


def test_ranges_are_asked_for_where_there_may_be_a_drone(monkeypatch: pytest.MonkeyPatch) -> None:
    infer, asked = OnnxModel.infer, {}

    def noted(model: OnnxModel, contents: dict[str, list[np.ndarray]]) -> dict[str, Float32Array]:
        asked[model.manifest.name] = len(contents["crop"])
        return infer(model, contents)

    monkeypatch.setattr(OnnxModel, "infer", noted)
    ranges()
    assert asked == {"verification_int8": 3, "distance_int8": 2}


def test_a_network_for_crops_of_another_size_is_refused(copies: Path) -> None:
    manifest = copies / "verification_int8.yaml"
    manifest.write_text(manifest.read_text(encoding="utf-8").replace("- 96\n", "- 64\n"), encoding="utf-8")
    with pytest.raises(ModelError):
        ranges(copies)
