"""The shipped models: whole, as their manifests say, and refused in one sentence when they are not."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from flockd.core.choices import ROLES
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.core.messages import FloatArray, Frame, UInt8Array
from flockd.flight.inference import OnnxModel, find_manifests, load_manifest
from flockd.flight.inference.manifest_file import read_manifest
from flockd.flight.perception import Crops, OnnxNetworks
from flockd.flight.perception.flow import DisFlow, OnnxFlow, grid_flow
from flockd.flight.perception.interface import RangeEstimates
from tests.flight.perception.cameras import crops_of, rendered
from tests.make import rig_camera
from tools.measure.labelled import half_overlap

MODELS = data_path("models")
NETWORKS = ("distance", "flow", "neighbours", "verification")
NAMES = ["detector", *(f"{network}{twin}" for network in NETWORKS for twin in ("", "_int8"))]


def test_the_models_fill_the_six_roles_and_twins_of_all_but_the_detector_five() -> None:
    manifests = [load_manifest(path)[0] for path in find_manifests(MODELS)]
    assert [m.name for m in manifests] == NAMES
    for twins in (False, True):
        roles = [role for m in manifests if m.name.endswith("_int8") == twins for role in m.roles]
        assert sorted(roles) == sorted(role for role in ROLES if not twins or role != "detector")


@pytest.mark.parametrize("name", NAMES)
def test_a_model_fills_its_roles_opens_and_gives_its_golden_output(name: str) -> None:
    assert read_manifest(MODELS / f"{name}.yaml").manifest.roles
    OnnxModel(MODELS / f"{name}.yaml", threads=1)


def test_the_detector_finds_a_drone_in_the_whole_image_and_its_evidence_is_for_it() -> None:
    view = rendered(222.0, (480, 352), (3.0, 0.3, -3.6))
    networks = OnnxNetworks(PerceptionConfig(flow="dis"), MODELS)
    maps = networks.scene(Frame("front", view.rgb, 0.0, 0), rig_camera(222.0, (480, 352)), None)
    (drone,) = [one for one in maps.instances if one.boxed]
    rows, columns = np.nonzero(view.ids == 1)
    seen = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    assert half_overlap(tuple(drone.box.tolist()), seen) > 0.5
    assert drone.evidence > 0


@pytest.mark.parametrize(
    ("role", "named", "said"),
    [
        ("flow", "distance", r"'distance' .*; choose one of flow, flow_int8, dis$"),
        ("flow", "raft", r"^perception\.flow: .*'raft'.*; choose one of flow, flow_int8, dis$"),
        ("distance", "../mine", r"^perception\.distance: .*'\.\./mine'.*; name .* \.\./mine/distance\.yaml$"),
        ("distance", "none", r"^perception\.distance: .*'none'.*; choose one of distance, distance_int8$"),
        ("distance", "/mine/range.onnx", r"^perception\.distance: /mine/range\.onnx .*; name .* /mine/range\.yaml$"),
    ],
    ids=["wrong role", "unknown", "folder", "without a second stage", "ONNX file"],
)
def test_who_names_something_beside_a_models_manifest_is_told_what_to_name(role: str, named: str, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        OnnxNetworks(PerceptionConfig.model_validate({role: named}), MODELS)


def shifted_pictures(shift: tuple[int, int], size: tuple[int, int]) -> tuple[UInt8Array, UInt8Array]:
    """Two windows of one rendered picture, so that all of the first has moved by ``shift`` px right and down."""
    width, height = size
    margin = 16
    view = rendered(250.0, (width + 2 * margin, height + 2 * margin))
    places = (margin, margin), (margin - shift[0], margin - shift[1])
    first, second = (np.ascontiguousarray(view.rgb[v : v + height, u : u + width]) for u, v in places)
    return first, second


@pytest.mark.parametrize("size", [(480, 640), (640, 480), (330, 250)])
def test_flow_finds_a_known_shift_at_any_image_size(size: tuple[int, int]) -> None:
    first, second = shifted_pictures((9, -5), size)
    ground = np.s_[size[1] // 2 + 16 : -32, 32:-32]
    dis = DisFlow().flow(first, second)[ground]
    assert np.abs(np.median(dis, axis=(0, 1)) - [9.0, -5.0]).max() < 0.2
    network = OnnxFlow(OnnxModel(MODELS / "flow.yaml", threads=1)).flow(first, second)
    assert network.shape == (size[1], size[0], 2)
    assert np.abs(np.median(network[ground], axis=(0, 1)) - [9.0, -5.0]).max() < 2.5


def test_the_twins_in_8_bits_say_what_the_float_networks_say() -> None:
    view = rendered(222.0, (320, 320), (1.5, -0.5, -4.2), (1.5, 0.5, -3.8))
    image = np.ascontiguousarray(view.rgb)
    roles = {"depth": "neighbours", "segmentation": "neighbours"}
    roles |= {name: name for name in ("flow", "distance", "verification")}
    twins = PerceptionConfig.model_validate({role: f"{name}_int8" for role, name in roles.items()})
    ours, theirs = (OnnxNetworks(config, MODELS) for config in (twins, PerceptionConfig.model_validate(roles)))
    camera, frame = rig_camera(222.0, (320, 320)), Frame("camera", image, 0.0, 0)
    our, their = (networks.scene(frame, camera, None) for networks in (ours, theirs))
    assert np.median(np.abs(our.depth / their.depth - 1)[their.depth < 50]) < 0.04
    both, any_ = ((f(our.labels > 0, their.labels > 0)).sum() for f in (np.logical_and, np.logical_or))
    assert both / any_ > 0.8
    pictures = crops_of([image[v - 48 : v + 48, u - 48 : u + 48] for u, v in ((86, 130), (234, 190))], 222.0)
    mine, others = ours.ranges(pictures), theirs.ranges(pictures)
    assert (others.drone_probability > 0.5).all()
    assert mine.log_range == pytest.approx(others.log_range, abs=0.05)
    np.testing.assert_allclose(mine.centre, others.centre, atol=1.5)


def test_the_network_of_flow_is_made_exact_as_configured() -> None:
    first, second = shifted_pictures((9, -5), (320, 240))
    network = OnnxFlow(OnnxModel(MODELS / "flow_int8.yaml", threads=1))
    no_drones = np.zeros(first.shape[:2], np.uint8)
    rough = network.flow(first, second)
    frames = Frame("camera", first, 0.0, 0), Frame("camera", second, 0.5, 1)
    for refinement, expected in (
        ("none", rough),
        ("dis", DisFlow(network).flow(first, second)),
        ("lucas_kanade", grid_flow(rough, first, second, no_drones)),
    ):
        networks = OnnxNetworks(PerceptionConfig.model_validate({"flow_refinement": refinement}), MODELS)
        np.testing.assert_allclose(networks.flow(*frames, no_drones), expected, atol=1e-4)


# The verification network beside the distance network: what it adds, and what it leaves alone.


def crops() -> Crops:
    """A drone before the sky, one before the ground, and ground alone."""
    taken = []
    for down_m, shown in ((-0.25, True), (0.35, True), (0.8, False)):
        pitch, _ = cv2.Rodrigues(np.array([0.0, -math.atan2(down_m, 1.5), 0.0]))
        view = rendered(100.0, (96, 96), *[(1.5, 0.0, -4.0 + down_m)] * shown, turned=np.asarray(pitch))
        taken.append(view.rgb)
    return crops_of(taken, 100.0)


def ranges(models: Path = MODELS, **names: str) -> RangeEstimates:
    return OnnxNetworks(PerceptionConfig.model_validate({"flow": "dis", **names}), models).ranges(crops())


def logits(estimates: RangeEstimates) -> FloatArray:
    p = estimates.drone_probability
    return np.asarray(np.log(p / (1.0 - p)))


def test_a_drone_keeps_the_range_that_the_distance_network_gives_and_what_is_none_gets_no_range() -> None:
    with_it, without = ranges(), ranges(verification="none")
    assert (with_it.drone_probability[:2] > 0.9).all()
    for name in ("log_range", "log_range_sigma", "size_m"):
        assert getattr(with_it, name)[:2] == pytest.approx(getattr(without, name)[:2], rel=1e-5)
    assert with_it.drone_probability[2] <= 0.2, "the least for another crop"
    assert math.isnan(with_it.log_range[2])


@pytest.mark.parametrize(("detector", "says"), [("none", "verification"), ("detector", "detector")])
def test_the_distance_networks_logit_is_added_up_to_the_limit(copies: Path, detector: str, says: str) -> None:
    manifest = copies / f"{says}.yaml"
    names = {"distance": "distance", "verification": "verification", "detector": detector}
    judge = copies / "verification.yaml"
    judge.write_text(judge.read_text("utf-8").replace("another_crop_probability: 0.2", "another_crop_probability: 0.0"))
    shipped = manifest.read_text(encoding="utf-8")

    def limited(limit: float) -> FloatArray:
        document = yaml.safe_load(shipped)
        document["thresholds"]["distance_logit_limit"] = limit
        manifest.write_text(yaml.safe_dump(document), encoding="utf-8")
        return logits(ranges(copies, **names))

    alone = logits(ranges(verification="none", distance="distance"))
    for limit in (0.5, 1.0):
        added = np.subtract(limited(limit), limited(0.0))
        assert added == pytest.approx(np.clip(alone, -limit, limit), abs=1e-3)
    assert min(alone[:2]) > 1.0
    assert alone[2] < -1.0
