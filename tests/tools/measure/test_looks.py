"""How labelled drones are told apart by their look, and the sheet of what was found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.ground.pictures import DetectedDrone, Labelled
from flockd.ground.pictures.single_frame import Box
from tools.measure.evaluation.on_pictures import Looks, look_of

BOX: Box = (90.0, 60.0, 130.0, 80.0)


def picture(drone: int, *, leaves: bool) -> np.ndarray:
    """A box of one grey before a sky from dark to light, or before black and white squares of four pixels."""
    rows, columns = np.mgrid[:160, :240]
    sky = 40 + rows
    behind = 255 * ((rows // 4 + columns // 4) % 2) if leaves else sky
    image = np.repeat(behind[..., None], 3, 2).astype(np.uint8)
    image[60:80, 90:130] = drone
    return image


@pytest.mark.parametrize(("drone", "leaves", "look"), [
    (230, False, "bright, plain"), (20, False, "dark, plain"),
    (230, True, "bright, cluttered"), (20, True, "dark, cluttered"),
])  # fmt: skip
def test_a_drone_is_bright_or_dark_and_what_is_around_it_plain_or_cluttered(
    drone: int, leaves: bool, look: str
) -> None:
    assert look_of(picture(drone, leaves=leaves), BOX) == look


def test_a_box_beyond_the_border_has_a_look_too() -> None:
    assert look_of(picture(230, leaves=False), (-50.0, 150.0, 20.0, 190.0)) == "bright, plain"


def test_what_is_found_missed_and_false_is_counted_and_drawn(tmp_path: Path) -> None:
    def detected(box: Box) -> DetectedDrone:
        centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        return DetectedDrone(box, centre, 0.99, 5.0, 0.1, 0.6, 0.01, 1)

    looks, image = Looks(), picture(230, leaves=False)
    looks.add(image, Labelled((detected(BOX), detected((10.0, 10.0, 30.0, 20.0))), (BOX,)))
    looks.add(image, Labelled((), (BOX,)))
    assert looks.counts == {"bright, plain": [1, 2]}
    assert [len(crops) for crops in (looks.found, looks.missed, looks.false)] == [1, 1, 1]
    looks.write(tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    middle = 80
    assert sheet[middle, middle].mean() == pytest.approx(230, abs=2), "the drone that was found, in the middle"
