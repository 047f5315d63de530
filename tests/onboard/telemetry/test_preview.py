"""Pictures of cameras for people: with what was detected, at most one a second, and never the pilot's work."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.config.rig import RigConfig
from flockd.core.messages import FrameSet, UInt8Array
from flockd.flight.geometry import build_rig, rotation_from_euler
from flockd.onboard.telemetry.preview import EVERY_S, FRESH_S, Previews, Step, preview
from tests import make

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 400.0
RIG = build_rig(RigConfig(cameras=(make.camera("front", (WIDTH, HEIGHT), FOCAL_PX),)))


def frames(time_s: float, grey: int = 0) -> FrameSet:
    return make.frames(time_s, {"front": np.full((HEIGHT, WIDTH, 3), grey, np.uint8)})


def stepped(seen: FrameSet, *bearings: tuple[float, float, float], **fields: Any) -> Step:
    """One detection of half a metre, 4 m away, in each direction (body FRD), each of a track of its own."""
    detections = tuple(make.detection(4.0 * np.array(bearing)) for bearing in bearings)
    output = make.output(detections=detections, detection_tracks=tuple(range(1, len(bearings) + 1)), **fields)
    return seen, make.vehicle(), output


def decoded(data: bytes | None) -> UInt8Array:
    assert data is not None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image, np.uint8)


def bright(image: UInt8Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of what is drawn into a black image."""
    rows, columns = np.nonzero(image > 60)
    return rows, columns


def test_a_detected_drone_is_boxed_where_the_lens_puts_it_and_one_behind_is_not() -> None:
    """20 degrees to the right: the tangent times the focal length, at half the size, from the middle."""
    right = (math.cos(math.radians(20)), math.sin(math.radians(20)), 0.0)
    step = stepped(frames(1.0), right, (-1.0, 0.0, 0.0))
    picture = decoded(Previews(RIG, lambda: (step[0], step), lambda: 0.0).picture("front"))
    assert picture.shape == (240, 320)
    half = 0.5 * FOCAL_PX * 0.5 / 4 / 2
    middle = 160 + 0.5 * FOCAL_PX * math.tan(math.radians(20))
    rows, columns = bright(picture[: round(120 + half)])  # above the text
    assert (rows.min(), columns.min()) == (pytest.approx(120 - half, abs=2), pytest.approx(middle - half, abs=2))
    assert columns.max() == pytest.approx(middle + half, abs=2)
    assert len(bright(picture[round(120 + half) + 3 :])[0]) > 50, "the range is below"


def test_a_confirmed_track_that_was_not_detected_is_where_it_is_expected() -> None:
    """The drone heads east, and expects another 4 m east and 1 m above: in the front camera's middle, and above it."""
    heads_east = make.vehicle(R_ned_body=rotation_from_euler(0.0, 0.0, math.pi / 2))
    for unseen_s, confirmed, drawn in ((1.0, True, True), (0.0, True, False), (1.0, False, False)):
        expected = make.neighbour(position=np.array([0.0, 4.0, -1.0]), unseen_s=unseen_s, confirmed=confirmed)
        seen, _, output = stepped(frames(1.0), neighbours=(expected,))
        picture = decoded(preview(seen.frames["front"], RIG.cameras["front"], (seen, heads_east, output)))
        rows, columns = bright(picture[:76])  # above the text
        assert (len(rows) > 0) == drawn
        if drawn:
            assert (rows.mean(), columns.mean()) == (
                pytest.approx(120 - 0.5 * FOCAL_PX / 4, abs=2),
                pytest.approx(160, abs=2),
            )


def test_a_picture_is_made_once_a_second_however_many_ask() -> None:
    now, asked = [0.0], [0]

    def newest() -> tuple[FrameSet | None, None]:
        asked[0] += 1
        return frames(now[0], grey=10 * asked[0]), None

    previews = Previews(RIG, newest, lambda: now[0])
    first = previews.picture("front")
    now[0] = 0.9 * EVERY_S
    assert all(previews.picture("front") == first for _ in range(5))
    assert asked == [1]
    now[0] = 1.1 * EVERY_S
    assert previews.picture("front") != first
    assert previews.picture("side") is None


def test_where_the_pilot_does_not_step_the_newest_frame_is_shown() -> None:
    old = stepped(frames(1.0, grey=50))
    for newer_s, grey in ((0.5 * FRESH_S, 50), (2.0 * FRESH_S, 200)):
        newest = frames(1.0 + newer_s, grey=200)
        picture = decoded(Previews(RIG, lambda newest=newest: (newest, old), lambda: 0.0).picture("front"))  # type: ignore[misc]
        assert picture.mean() == pytest.approx(grey, abs=2)
    assert Previews(RIG, lambda: (None, None), lambda: 0.0).picture("front") is None
