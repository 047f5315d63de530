"""A detector's boxes beside the instances of the segmentation."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from flockd.core.data import data_path
from flockd.core.messages import FloatArray
from flockd.flight.inference import OnnxModel
from flockd.flight.perception.detection.boxes import BoxRules, kept_boxes, probable_boxes, with_boxes
from flockd.flight.perception.detection.instances import Instance

RULES = BoxRules(least_probability=0.05, overlap=0.5, gain=0.5, large=4.0, small=3.0, no_box=-2.0)
DRONE = (100.0, 50.0, 140.0, 70.0)


def columns(*rows: tuple[float, ...]) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    """As a detector gives them: centre, size, probability."""
    names = ("centre_right_px", "centre_down_px", "width_px", "height_px", "drone_probability")
    return dict(zip(names, np.array(rows, np.float32).T, strict=True))


def instance(label: int, box: tuple[float, ...], area_px: float = 100.0) -> Instance:
    corners = np.array(box)
    return Instance(label, (corners[:2] + corners[2:]) / 2, corners, area_px, score=1.0)


def boxes(*given: tuple[float, ...]) -> FloatArray:
    return np.array(given, float).reshape(-1, 4)


def found(*rows: tuple[float, ...], scale: tuple[float, float] = (1.0, 1.0)) -> tuple[FloatArray, FloatArray]:
    return kept_boxes(*probable_boxes(columns(*rows), RULES, scale), RULES)


def test_of_two_boxes_of_one_drone_the_more_probable_one_stays() -> None:
    kept, odds = found((50, 40, 20, 10, 0.6), (51, 40, 20, 10, 0.8), (90, 40, 20, 10, 0.5))
    assert kept == pytest.approx(boxes((41, 35, 61, 45), (80, 35, 100, 45)))
    assert odds == pytest.approx([np.log(4.0), 0.0], abs=1e-6)


def test_a_detector_that_is_sure_of_all_counts_as_one_that_is_right_in_nineteen_of_twenty() -> None:
    _, odds = found((50, 40, 20, 10, 1.0))
    assert odds == pytest.approx([np.log(19.0)])


def test_boxes_are_in_pixels_of_the_image_and_not_of_what_the_detector_saw() -> None:
    kept, _ = found((50, 40, 20, 10, 0.6), scale=(0.5, 0.25))
    assert kept == pytest.approx(boxes((80, 140, 120, 180)))


def test_an_improbable_box_is_none() -> None:
    kept, odds = found((50, 40, 20, 10, 0.04))
    assert kept.shape == (0, 4)
    assert odds.shape == (0,)


def test_an_instance_takes_the_box_that_is_the_same_drone_and_keeps_its_label() -> None:
    labels = np.zeros((100, 200), np.uint8)
    labels[55:65, 105:135] = 3
    one = instance(3, (105, 55, 135, 65))
    marked, seen = with_boxes(labels, (one,), boxes(DRONE), np.array([2.0]), RULES)
    (drone,) = seen
    assert (drone.label, drone.area_px) == (3, 100.0)
    assert drone.box == pytest.approx(DRONE)
    assert drone.centre == pytest.approx([120, 60])
    assert drone.evidence == pytest.approx(0.5 * 2.0)
    assert set(np.unique(marked)) == {0, 3}


def test_what_only_the_detector_finds_gets_a_label_of_its_own_and_comes_first() -> None:
    far = instance(1, (10, 10, 20, 20))
    _, seen = with_boxes(np.zeros((100, 200), np.uint8), (far,), boxes(DRONE), np.array([-1.0]), RULES)
    assert [one.label for one in sorted(seen, key=lambda one: -one.score)] == [2, 1]
    assert seen[0].evidence == pytest.approx(-0.5)


def test_what_only_the_segmentation_finds_is_less_likely_a_drone() -> None:
    _, (one,) = with_boxes(
        np.zeros((100, 200), np.uint8), (instance(1, (10, 10, 20, 20)),), boxes(), np.zeros(0), RULES
    )
    assert one.evidence == RULES.no_box


@pytest.mark.parametrize(
    ("width_px", "added"),
    [(5, 3.0), (8, 3.0), (160**0.5, 1.5), (20, 0.0), (40, 0.0), (40 * 7.5**0.5, 2.0), (300, 4.0), (600, 4.0)],
)
def test_what_the_second_stage_says_against_a_small_or_a_large_box_counts_less(width_px: float, added: float) -> None:
    assert RULES.evidence(np.array([0.0, 0.0, width_px, 20.0]), -4.0) == pytest.approx(0.5 * -4.0 + added)


def test_the_shipped_rules_are_those_of_its_manifest() -> None:
    given = yaml.safe_load((data_path("models") / "detector.yaml").read_text(encoding="utf-8"))["thresholds"]
    rules = BoxRules.of(OnnxModel(data_path("models") / "detector.yaml", threads=1).manifest)
    assert (rules.gain, rules.large, rules.small, rules.no_box) == tuple(
        given[name] for name in ("evidence_gain", "large_box_evidence", "small_box_evidence", "no_box_evidence")
    )
    assert len({rules.gain, rules.large, rules.small, rules.no_box}) == 4


def test_a_small_box_never_counts_more_than_the_surest_one() -> None:
    small = np.array([0.0, 0.0, 6.0, 4.0])
    assert RULES.evidence(small, 2.0) == pytest.approx(0.5 * np.log(19.0))
    assert RULES.evidence(small, np.log(19.0)) == pytest.approx(0.5 * np.log(19.0))


def test_the_parts_of_a_large_drone_are_one_with_it() -> None:
    labels = np.zeros((100, 200), np.uint8)
    labels[52:56, 101:108], labels[52:56, 131:139] = 1, 2
    parts = (instance(1, (101, 52, 108, 56)), instance(2, (131, 52, 139, 56)))
    marked, seen = with_boxes(labels, parts, boxes(DRONE), np.array([3.0]), RULES)
    (drone,) = seen
    assert set(np.unique(marked)) == {0, drone.label}
    assert (marked == drone.label).sum() == 4 * 7 + 4 * 8


def test_a_smaller_drone_before_a_large_one_stays_where_it_has_a_box_of_its_own() -> None:
    small = (102.0, 52.0, 116.0, 58.0)
    _, seen = with_boxes(
        np.zeros((100, 200), np.uint8), (instance(1, small),), boxes(small, DRONE), np.array([3.0, 2.0]), RULES
    )
    assert [one.box.tolist() for one in seen] == [list(small), list(DRONE)]
