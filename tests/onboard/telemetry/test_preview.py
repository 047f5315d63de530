"""Pictures of cameras for people: with what was detected, at most one a second, and never the pilot's work."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from flockd.core.config.rig import RigConfig
from flockd.core.messages import FrameSet, PilotOutput, UInt8Array
from flockd.flight.geometry import build_rig
from flockd.onboard.telemetry.preview import EVERY_S, FRESH_S, Previews
from tests import make

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 400.0
RIG = build_rig(RigConfig(cameras=(make.camera("front", (WIDTH, HEIGHT), FOCAL_PX),)))


def frames(time_s: float, grey: int = 0) -> FrameSet:
    return make.frames(time_s, {"front": np.full((HEIGHT, WIDTH, 3), grey, np.uint8)})


def output(*bearings: tuple[float, float, float]) -> PilotOutput:
    """One detection of half a metre, 4 m away, in each direction (body FRD)."""
    return make.output(detections=tuple(make.detection(4.0 * np.array(bearing)) for bearing in bearings))


def decoded(data: bytes | None) -> UInt8Array:
    assert data is not None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image, np.uint8)


def test_a_detected_drone_is_circled_where_the_lens_puts_it_and_one_behind_is_not() -> None:
    """20 degrees to the right: the tangent times the focal length, at half the size, from the middle."""
    right = (math.cos(math.radians(20)), math.sin(math.radians(20)), 0.0)
    stepped = frames(1.0), output(right, (-1.0, 0.0, 0.0))
    picture = decoded(Previews(RIG, lambda: (stepped[0], stepped), lambda: 0.0).picture("front"))
    assert picture.shape == (240, 320)
    rows, columns = np.nonzero(picture[110:] > 60)  # below the text
    assert columns.mean() == pytest.approx(160 + 0.5 * FOCAL_PX * math.tan(math.radians(20)), abs=3)
    assert rows.max() + 110 == pytest.approx(120 + 0.5 * FOCAL_PX * 0.5 / 4 / 2 + 3, abs=2)


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
    old = frames(1.0, grey=50), output()
    for newer_s, grey in ((0.5 * FRESH_S, 50), (2.0 * FRESH_S, 200)):
        newest = frames(1.0 + newer_s, grey=200)
        picture = decoded(Previews(RIG, lambda newest=newest: (newest, old), lambda: 0.0).picture("front"))  # type: ignore[misc]
        assert picture.mean() == pytest.approx(grey, abs=2)
    assert Previews(RIG, lambda: (None, None), lambda: 0.0).picture("front") is None
