"""How detections in labelled pictures are matched and measured: every figure by hand."""

from __future__ import annotations

import pytest

from flockd.ground.pictures.scoring import (
    Labelled,
    average_precision,
    centre_in_box,
    intersection_over_union,
    match,
    overlap,
    summary,
    width_class,
)
from flockd.ground.pictures.single_frame import Box, DetectedDrone

BOX = (10.0, 10.0, 30.0, 20.0)


def found(box: Box, probability: float = 0.9) -> DetectedDrone:
    centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    return DetectedDrone(box, centre, probability, 5.0, 0.1, 0.6, 0.012, 1)


def moved(right: float) -> Box:
    return BOX[0] + right, BOX[1], BOX[2] + right, BOX[3]


@pytest.mark.parametrize(("right", "iou"), [(0.0, 1.0), (10.0, 100 / 300), (5.0, 150 / 250), (20.0, 0.0), (-30.0, 0.0)])
def test_intersection_over_union(right: float, iou: float) -> None:
    """Boxes 20 x 10 are moved against each other."""
    assert intersection_over_union(BOX, moved(right)) == pytest.approx(iou)
    classes = ("0-6", "6-12", "6-12", "12-30", "12-30", "30-80", "30-80", "80-", "80-")
    assert tuple(width_class((0, 0, w, 5)) for w in (3, 6, 11.9, 12, 29, 30, 79, 80, 300)) == classes


def test_a_box_is_found_once_by_the_most_probable_and_all_else_is_false() -> None:
    boxes = (BOX, (100.0, 100.0, 110.0, 105.0))
    picture = Labelled((found(BOX), found(moved(2), 0.95), found(moved(50))), boxes)
    assert match(picture, centre_in_box) == ([True, False], [(0.95, True), (0.9, False), (0.9, False)])


def test_of_two_boxes_a_detection_takes_the_one_that_it_fits_best() -> None:
    wide = (0.0, 0.0, 60.0, 40.0)
    picture = Labelled((found(BOX, 0.9), found((25.0, 15.0, 45.0, 35.0), 0.8)), (wide, BOX))
    assert match(picture, centre_in_box)[0] == [True, True]
    assert match(picture, overlap(0.5))[0] == [False, True]


def test_average_precision_by_hand() -> None:
    """Three boxes: hit, miss, hit. Precision 1 at recall 1/3, 2/3 at 2/3: area 1/3 + 2/9. The third is not found."""
    judged = [(0.7, True), (0.9, True), (0.8, False)]
    assert average_precision(judged, 3) == pytest.approx(1 / 3 + 2 / 9)
    assert average_precision([], 3) == 0.0
    assert average_precision([(0.9, False)], 0) is None
    # A miss before the hit costs it: precision is 1/2 at recall 1. Of equal probabilities none is before the other.
    assert average_precision([(0.9, False), (0.8, True)], 1) == pytest.approx(0.5)
    assert average_precision([(0.9, True), (0.9, False)], 1) == average_precision([(0.9, False), (0.9, True)], 1) == 0.5


def test_a_summary_of_pictures_with_and_without_drones() -> None:
    """Boxes 20 px wide: hit well; hit with IoU 1/3, beside a false one; not found; and a false one where none is."""
    ghost = (200.0, 200.0, 230.0, 220.0)
    pictures = [
        Labelled((found(BOX, 0.99),), (BOX,)),
        Labelled((found(moved(9.9), 0.9), found(ghost, 0.95)), (BOX,)),
        Labelled((), (BOX,)),
        Labelled((found(ghost, 0.85),)),
    ]
    nothing = {"boxes": 0, "found": 0}
    assert summary(pictures) == {
        "boxes": 3,
        "by_width": {
            "0-6": nothing, "6-12": nothing, "12-30": {"boxes": 3, "found": 2}, "30-80": nothing,
            "80-": nothing,
        },
        "ap50": round(1 / 3, 4),
        "measured": 4,
        "false": 2,
        "false_per_picture": 0.5,
    }  # fmt: skip
    assert (summary([])["ap50"], summary([])["false_per_picture"]) == (None, None)
