"""A video shows what was seen, step by step."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.core.messages import UInt8Array
from flockd.onboard.recording.reader import Recording
from flockd.review.report.flight_video import Outline, VideoStep, drawn, recorded_steps
from flockd.review.report.style import DRONE_COLOURS
from tests.review.report.test_page import _flight

NORMAL = Path(__file__).parents[2] / "review" / "replay" / "normal.mcap"
HEAD_PX, GAP_PX, IMAGES_PX = 36, 6, 640
Capture = pytest.CaptureFixture[str]


def test_a_ring_is_drawn_where_the_drone_was_seen() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    ring = np.stack([32 + 10 * np.cos(angles), 24 + 10 * np.sin(angles)], axis=1)
    grey = np.full((48, 64, 3), 90, np.uint8)
    image = drawn(VideoStep(1.0, {"front": grey}, {"front": [Outline(ring, 0, 4.2)]}), "drone1")
    assert all(side % 2 == 0 for side in image.shape[:2]), "as encoders want them"
    scale, wanted = IMAGES_PX / 48, [int(DRONE_COLOURS[0][i : i + 2], 16) for i in (1, 3, 5)]
    rows, columns = np.nonzero(np.linalg.norm(image[HEAD_PX:, GAP_PX:] - np.array(wanted, float), axis=2) < 60.0)
    middle = np.array([np.ptp(columns) / 2 + columns.min(), np.ptp(rows) / 2 + rows.min()])
    assert np.abs(middle - scale * np.array([32, 24])).max() < 5.0
    assert np.ptp(columns) / 2 == pytest.approx(10 * scale, abs=5.0)


def test_images_of_several_cameras_do_not_touch() -> None:
    white = np.full((48, 64, 3), 250, np.uint8)
    image = drawn(VideoStep(0.0, dict.fromkeys(("front", "right", "back", "left"), white), {}), "drone1")
    seen = image[HEAD_PX:].min(axis=2) > 200
    for lit in (seen.any(axis=0).nonzero()[0], seen.any(axis=1).nonzero()[0]):
        assert lit.size <= np.ptp(lit) - GAP_PX + 1, "a gap between left and right, above and below"


def test_recorded_moments_have_the_recorded_detections() -> None:
    """In the recording a neighbour is 2 to 4 m before the drone, in the front camera."""
    recording = Recording(NORMAL)
    moments = list(recorded_steps(recording))
    assert len(moments) == len(recording.contents.steps)
    assert moments[0].time_s == pytest.approx(0.0, abs=0.5)
    seen = [outline for moment in moments for outline in moment.outlines.get("front", ())]
    assert len(seen) >= len(moments) - 2
    for outline in seen:
        assert outline.track is not None
        assert 1.5 < (outline.range_m or 0.0) < 6.0
    image = moments[-1].images["front"]
    (outline,) = moments[-1].outlines["front"]
    assert (outline.pixels >= 0.0).all()
    assert (outline.pixels <= image.shape[1::-1]).all()
    assert np.ptp(outline.pixels[:, 0]) == pytest.approx(np.ptp(outline.pixels[:, 1]), rel=0.15), "a circle"


def test_a_recording_becomes_a_video(tmp_path: Path, capfd: Capture) -> None:
    video = tmp_path / "flight.mp4"
    assert main(["report", str(NORMAL), "--video", str(video), "--json"]) == 0
    captured = capfd.readouterr()
    told = json.loads(captured.out)
    assert captured.err == ""
    assert (told["video"], told["frames"]) == (str(video), len(Recording(NORMAL).contents.steps))
    assert list(tmp_path.iterdir()) == [video], "no draft is left, and no report is written"
    played, images = cv2.VideoCapture(str(video)), list[UInt8Array]()
    assert played.get(cv2.CAP_PROP_FPS) == pytest.approx(told["frames"] / told["seconds"], rel=0.01)
    while (read := played.read())[0]:
        images.append(np.asarray(read[1], np.uint8))
    assert len(images) == told["frames"]

    def refused(*options: str) -> str:
        assert main(["report", *options]) == 2
        return capfd.readouterr().err

    assert refused(str(NORMAL), "--video", str(video)).startswith(f"{video}: exists; ")
    assert "ends in .webm or .mp4" in refused(str(NORMAL), "--video", "flight.avi")
    assert "make it first" in refused(str(NORMAL), "--video", str(tmp_path / "nowhere" / "flight.webm"))
    assert "--out has no meaning" in refused(str(NORMAL), "--video", "new.webm", "--out", "x")
    assert "--drone is for --video" in refused(str(NORMAL), "--drone", "drone1")
    new = str(tmp_path / "new.webm")
    assert "name one of " in refused(str(NORMAL), "--video", new, "--drone", "nobody")
    (tmp_path / "flight").mkdir()
    _flight(drones=2, duration_s=1.0).save(tmp_path / "flight" / "flight.npz")
    assert "fly with --record" in refused(str(tmp_path / "flight"), "--video", new)
