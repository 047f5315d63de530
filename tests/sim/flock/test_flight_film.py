"""The film of a flight: where drones are drawn, and that a drone which was taken out is not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.messages import UInt8Array
from flockd.sim.flock.flight_film import FlightFilm, seen_from_above
from tests import make

PLACES = np.array([[0.0, 0.0, -5.0], [3.0, 0.0, -5.0], [0.0, 4.0, -9.0]])


def _dark(image: UInt8Array, u: float, v: float) -> bool:
    return bool(image[round(v), round(u)].max() < 130)


def test_north_is_up_and_east_is_right_of_the_flock_s_middle() -> None:
    """The middle is 1.5 m north and 2 m east, and the edge is 6 m from it: 40 pixels a metre of 480."""
    image = seen_from_above(3.0, PLACES[None, :, :2], PLACES, 480)
    assert image[240 + 60, 240 - 80].tolist() == [255, 109, 0], "the first drone in its own colour"
    assert _dark(image, 240 - 80, 240 - 60), "3 m north of it"
    assert _dark(image, 240 + 80, 240 + 60), "4 m east of it"


def test_a_drone_that_was_taken_out_is_not_drawn_and_another_flight_begins_without_trails() -> None:
    images: list[UInt8Array] = []
    picture = cv2.imencode(".jpg", np.full((320, 240, 3), 200, np.uint8))[1].tobytes()
    scenario = make.scenario()
    film = FlightFilm(scenario, lambda camera: picture if camera == "front" else None, images.append)
    film.add(0.0, PLACES)
    film.add(0.5, 1.5 * PLACES)
    film.add(0.0, PLACES)
    film.add(0.0, PLACES, removed=[2])
    first, _, again, without = images
    assert first.shape == (640, 640 + 480, 3)
    assert first[300, 700].tolist() == [200, 200, 200], "the front camera's picture"
    assert first[600, 1000].tolist() == [255, 255, 255], "there is no other"
    assert np.array_equal(first, again)
    others, other = ((image == [90, 98, 110]).all(-1).sum() for image in (first, without))
    assert others == pytest.approx(2 * other, rel=0.05)
