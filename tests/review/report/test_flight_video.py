"""A video shows what was seen and where everybody was, step by step."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.core.messages import FloatArray, UInt8Array
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.flight_video import Outline, VideoStep, recorded_steps, write_video
from flockd.review.report.style import DRONE_COLOURS
from tests.review.report.test_page import _flight

NORMAL = Path(__file__).parents[2] / "review" / "replay" / "normal.mcap"
SCALE = 0.5
"""Encoding takes as long as there are pixels."""
MAP_PX, HEAD_PX = 320, 18
GREY = np.full((48, 64, 3), 90, np.uint8)
Capture = pytest.CaptureFixture[str]


def _frames(path: Path) -> tuple[list[UInt8Array], float]:
    """RGB, and frames a second."""
    video = cv2.VideoCapture(str(path))
    rate_hz, images = video.get(cv2.CAP_PROP_FPS), []
    while (read := video.read())[0]:
        images.append(np.asarray(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB), np.uint8))
    video.release()
    return images, rate_hz


def _near(image: UInt8Array, colour: str, within: float = 60.0) -> FloatArray:
    """(n, 2) pixels, across and down, of about this colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], float)
    rows, columns = np.nonzero(np.linalg.norm(image - wanted, axis=2) < within)
    return np.stack([columns, rows], axis=1).astype(float)


def _shown(log: FlightLog) -> Iterator[VideoStep]:
    """One camera with a ring of track 0 in the middle of its image."""
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    ring = np.stack([32 + 10 * np.cos(angles), 24 + 10 * np.sin(angles)], axis=1)
    for time_s in log.time_s.tolist():
        yield VideoStep(time_s, {"front": GREY}, {"front": [Outline(ring, 0, 4.2)]})


def test_each_step_is_a_frame_with_the_ring_in_the_image_and_the_drones_on_the_map(
    tmp_path: Path, capfd: Capture
) -> None:
    log = _flight(drones=2, duration_s=1.0)
    path = tmp_path / "flight.webm"
    told: list[tuple[int, int]] = []
    assert write_video(path, log, 0, _shown(log), lambda *counts: told.append(counts), scale=SCALE) == len(log.time_s)
    images, rate_hz = _frames(path)
    assert len(images) == len(log.time_s)
    assert rate_hz == pytest.approx(1.0 / log.metadata.step_s, rel=0.01)
    assert told[-1] == (len(log.time_s), len(log.time_s))
    assert list(tmp_path.iterdir()) == [path], "no draft is left"
    assert capfd.readouterr().err == ""

    # The image of 64x48 stands as high as the map at the left.
    first, last = images[0], images[-1]
    scale = MAP_PX / 48
    seen = _near(first[HEAD_PX:, : round(64 * scale)], DRONE_COLOURS[0])
    across, down = seen.min(axis=0), seen.max(axis=0)
    assert np.abs((across + down) / 2 - scale * np.array([32, 24])).max() < 5.0
    assert np.abs((down - across) / 2 - 10 * scale).max() < 5.0

    # On the map drone 2 moves as the log has it.
    def on_map(image: UInt8Array) -> FloatArray:
        """Where its disc is: the widest of what has its colour."""
        near = _near(image[HEAD_PX:, -MAP_PX:], DRONE_COLOURS[1])
        return np.asarray(np.median(near, axis=0))

    moved = log.position[-1, 1, :2] - log.position[0, 1, :2]
    shown = on_map(last) - on_map(first)
    assert np.linalg.norm(shown) > 3.0
    direction = np.array([shown[0], -shown[1]]) / np.linalg.norm(shown)
    assert direction @ moved[::-1] / np.linalg.norm(moved) > 0.9, "east is right, north is up"


def test_images_of_several_cameras_do_not_touch(tmp_path: Path) -> None:
    log = _flight(drones=2, duration_s=0.5)
    names = ("front", "right", "back", "left")
    white = np.full((48, 64, 3), 250, np.uint8)
    moment = VideoStep(0.0, dict.fromkeys(names, white), {})
    path = tmp_path / "flight.webm"
    write_video(path, log, 0, [moment], scale=SCALE)
    (image,), _ = _frames(path)
    seen = image[HEAD_PX : HEAD_PX + MAP_PX, : -MAP_PX - 6].min(axis=2) > 200
    assert seen.any(axis=0).nonzero()[0].size < np.ptp(seen.any(axis=0).nonzero()[0]), "a gap between left and right"
    assert seen.any(axis=1).nonzero()[0].size < np.ptp(seen.any(axis=1).nonzero()[0]), "and between above and below"


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


def test_a_flights_folder_without_recordings_gives_its_map(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "flight"
    folder.mkdir()
    _flight(drones=2, duration_s=1.0).save(folder / "flight.npz")
    video = tmp_path / "flight.mp4"
    assert main(["report", str(folder), "--video", str(video), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["video"] == str(video)
    assert len(_frames(video)[0]) == told["frames"]
    assert sorted(path.name for path in folder.iterdir()) == ["flight.npz"], "no report is written"

    def refused(*options: str) -> str:
        assert main(["report", str(folder), *options]) == 2
        return capsys.readouterr().err

    assert refused("--video", str(video)) == f"{video} exists; name another file, or overwrite it with --force\n"
    assert "a video's name ends in .webm or .mp4" in refused("--video", "flight.avi")
    assert "is not a folder; make it first" in refused("--video", str(tmp_path / "nowhere" / "flight.webm"))
    assert "--out has no meaning with --video; drop it" in refused("--video", "new.webm", "--out", "x")
    assert "--drone is for --video; drop it" in refused("--drone", "drone1")
    assert "has no recordings; drop it, or fly with --record" in refused("--video", "new.webm", "--drone", "drone2")
