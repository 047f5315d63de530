"""How detections in pictures are scored."""

from __future__ import annotations

from tools.evaluation.on_pictures import FoundDrone, Labelled, PictureResult, match, summary, width_class


def found(u: float, v: float, probability: float = 0.9) -> FoundDrone:
    return FoundDrone((u, v), probability, 5.0, 0.6)


def test_boxes_fall_into_classes_by_their_width() -> None:
    assert [width_class((0, 0, w, 5)) for w in (3, 6, 11.9, 12, 29, 30, 79, 80, 300)] == [
        "0-6", "6-12", "6-12", "12-30", "12-30", "30-80", "30-80", "80-", "80-",
    ]  # fmt: skip


def test_a_box_is_found_once_and_all_else_is_false() -> None:
    boxes = ((10.0, 10.0, 30.0, 20.0), (100.0, 100.0, 110.0, 105.0))
    picture = Labelled(PictureResult((found(20, 15), found(22, 15, 0.95), found(50, 50)), 7), boxes)
    assert match(picture) == ([True, False], 2)
    assert match(picture, 0.93) == ([True, False], 0)


def test_a_summary_counts_false_detections_in_500_images() -> None:
    drone = Labelled(PictureResult((found(20, 15),), 3), ((10.0, 10.0, 30.0, 20.0),))
    ghost = Labelled(PictureResult((found(20, 15),), 5))
    told = summary([drone, ghost, ghost, Labelled(PictureResult((), 1))])
    assert told == {
        "images": 4,
        "by_width": {"12-30": {"boxes": 1, "found": 1}},
        "false_per_500_images": 250.0,
        "proposals_per_image": 3.5,
    }
