"""`flockd calibrate` as a person runs it: from every kind of source to a file that checks, or to one sentence."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.messages import Frame, FrameSet, UInt8Array
from flockd.ground.calibration.board import BoardFinder, BoardSpec
from flockd.onboard.sources import CameraStatus
from tests.conftest import Told
from tests.ground.calibration import darkroom
from tests.ground.calibration.darkroom import PINHOLE, facing, photograph

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def pictures() -> list[UInt8Array]:
    return [photograph(PINHOLE, place, seed=k) for k, place in enumerate(darkroom.sight(PINHOLE, 12))]


@pytest.fixture
def folder(tmp_path: Path, pictures: list[UInt8Array]) -> Path:
    """A folder of pictures, two of which are of no use."""
    path = tmp_path / "pictures"
    path.mkdir()
    for number, image in enumerate(pictures):
        write(path / f"{number:02}.png", image)
    write(path / "wall.png", photograph(PINHOLE, facing((0.0, 0.0, -1.0))))
    write(path / "soft.png", photograph(PINHOLE, facing((0.03, 0.0, 0.28), 20.0), blur_px=2.0))
    return path


def write(path: Path, image: UInt8Array) -> None:
    assert cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def test_a_folder_of_images_becomes_a_camera_that_checks(folder: Path, told: Told) -> None:
    out = folder.with_name("front.yaml")
    command = ("calibrate", "camera", folder, "--camera", "front", "--out", out)
    text = told(0, *command, "--model", "pinhole")
    assert "refused: {blurred: 1, no board: 1}" in text
    assert re.search(r"blurred: \{soft\.png: \d\.\d+\}", text)
    assert re.search(r"## where corners of the board were seen:\n(## |\.\. ){7}", text)
    told(0, "config", "check", out)
    camera = load_drone(out).rig.cameras[0]
    assert (camera.name, camera.size_px) == ("front", (480, 360))
    assert camera.intrinsics.fx == pytest.approx(PINHOLE.fx, rel=0.005)
    measured = camera.intrinsics.measured
    assert measured is not None
    assert (measured.views, measured.source) == (12, str(folder))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", measured.date)
    assert measured.residual_px is not None
    assert 0.02 < measured.residual_px < 0.12
    # A whole drone takes it as it is.
    drone = folder.with_name("drone.yaml")
    drone.write_text("name: d\nstep_s: 0.2\n" + out.read_text(), encoding="utf-8")
    told(0, "config", "check", drone)
    # Nothing that is there is lost by accident.
    before = out.read_bytes()
    assert f"{out}: exists; name another file, or overwrite it with --force" in told(2, *command)
    assert out.read_bytes() == before
    facts = json.loads(told(0, *command, "--force", "--json"))
    assert set(facts["models"]) == {"pinhole", "wide_angle"}
    assert facts["intrinsics"]["model"] == "pinhole"
    assert facts["refused"] == {"no board": 1, "blurred": 1}
    assert set(facts["residual_px"]["views"]) == {f"{number:02}.png" for number in range(12)}


def test_what_is_not_enough_is_said_in_one_sentence(folder: Path, told: Told, tmp_path: Path) -> None:
    out = tmp_path / "out.yaml"
    command = ("calibrate", "camera", folder, "--out", out)
    for file in sorted(folder.glob("0[4-9].png")) + sorted(folder.glob("1*.png")):
        file.unlink()
    assert "4 usable views of the board are too few; show it at least 6 times" in told(1, *command)
    write(folder / "zz.png", np.zeros((100, 100, 3), np.uint8))
    assert "zz.png: is 100 x 100 pixels and 00.png is 480 x 360" in told(1, *command)
    for file in folder.glob("*.png"):
        file.unlink()
    assert "has no images" in told(1, *command)
    write(folder / "wall.png", np.full((360, 480, 3), 90, np.uint8))
    assert "in none of the 1 images (1 no board), and the last shows no markers; check" in told(1, *command)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    theirs = np.asarray(cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary).generateImage((480, 360)), np.uint8)
    write(folder / "wall.png", np.stack([theirs] * 3, axis=2))
    assert "the last shows 17 markers of 6X6_" in told(1, *command)
    older = BoardSpec(7, 6, 0.036, legacy=True).image(60)
    write(folder / "wall.png", np.stack([np.pad(older, 60, constant_values=255)] * 3, axis=2))
    assert "shows the board as OpenCV before 4.6 makes it, for which --legacy is" in told(
        1, *command, "--squares", "7x6"
    )
    assert "1 usable views" in told(1, *command, "--squares", "7x6", "--legacy")
    board = np.pad(BoardSpec(7, 5, 0.036).image(60), 60, constant_values=255)
    for image, shown, squares in (
        (board, "the board of 7x5 squares", "5x7"),
        (board[:, ::-1], "the board mirrored; let the camera not mirror its images", "7x5"),
        (255 - board, "the board with black and white exchanged; print it black on white", "7x5"),
    ):
        write(folder / "wall.png", np.stack([image] * 3, axis=2))
        assert f"the last shows {shown}" in told(1, *command, "--squares", squares)
    assert "no SOURCE was given" in told(2, "calibrate", "camera", "--out", out)
    assert "needs 70 markers" in told(2, *command, "--squares", "10x14")
    assert "squares of 0.036 mm are not printed; take 1 to 1000 mm" in told(2, *command, "--square-mm", "0.036")
    assert not out.exists()


class Film:
    """A live camera that shows each picture twice, as a board held still; then somebody presses Ctrl-C."""

    def __init__(self, images: Sequence[UInt8Array]) -> None:
        self._images = iter([image for image in images for _ in range(2)])
        self.began = self.ended = False

    def start(self) -> None:
        self.began = True

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
        image = next(self._images, None)
        if image is None:
            raise KeyboardInterrupt
        return FrameSet(1.0, {"front": Frame("front", image, 1.0, 1)})

    def status(self) -> Mapping[str, CameraStatus]:
        return {}

    def stop(self) -> None:
        self.ended = True


def plugged_in(folder: Path, device: str = "/dev/video7") -> str:
    """The file of a drone with one camera there, whose lens nobody knows."""
    lens = "intrinsics: {fx: 480, fy: 480, cx: 240, cy: 180}"
    source = f"source: {{kind: v4l2, cameras: [{{name: front, device: {device}}}]}}"
    file = folder / "plugged_in.yaml"
    file.write_text(f"rig: {{cameras: [{{name: front, size_px: [480, 360], {lens}}}]}}\n{source}\n", encoding="utf-8")
    return str(file)


def test_before_a_live_camera_a_person_gets_instructions(
    pictures: list[UInt8Array], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = Film(pictures[:8])
    monkeypatch.setattr("flockd.ground.calibration.image_sources.open_source", lambda config, file: film)
    out = tmp_path / "live.yaml"
    command = ("calibrate", "camera", "--config", plugged_in(tmp_path), "--out", str(out))
    assert main([*command, "--model", "pinhole", "--json"]) == 0
    captured = capsys.readouterr()
    facts = json.loads(captured.out)
    assert (facts["views"], facts["refused"]) == (8, {"moving": 8})
    assert facts["intrinsics"]["fx"] == pytest.approx(PINHOLE.fx, rel=0.01)
    lines = captured.err.splitlines()
    assert lines[0].startswith("0 views, 0 % covered: ")
    assert re.match(r"1 views, \d+ % covered: .* 30 to 45 degrees, ", lines[1])
    assert film.ended
    measured = load_drone(out).rig.cameras[0].intrinsics.measured
    assert measured is not None
    assert measured.camera == "/dev/video7"


def test_a_camera_that_is_not_there_is_unavailable(tmp_path: Path, told: Told, monkeypatch: Any) -> None:
    monkeypatch.setattr("flockd.ground.calibration.image_sources.FIRST_FRAME_S", 0.2)
    assert "/dev/video93 is not there; plug the camera in" in told(
        69, "calibrate", "camera", "--config", plugged_in(tmp_path, "/dev/video93"), "--out", tmp_path / "a"
    )


def test_the_board_is_printed_in_its_true_size(tmp_path: Path, told: Told) -> None:
    page = tmp_path / "board.svg"
    assert "print it at 100 % on paper of 276 x 204 mm" in told(0, "calibrate", "camera", "--print-board", page)
    drawing = ElementTree.fromstring(page.read_text(encoding="utf-8"))
    assert (drawing.attrib["width"], drawing.attrib["height"]) == ("276mm", "204mm")
    assert drawing.attrib["viewBox"] == "0 0 276 204"
    board = drawing[1].attrib
    assert board["transform"] == "translate(12 12) scale(4.5)", "eight cells are 36 mm"
    cells = np.full((40, 56), 255, np.uint8)
    for x, y in re.findall(r"M(\d+) (\d+)h1v1h-1z", board["d"]):
        cells[int(y), int(x)] = 0
    framed = cv2.copyMakeBorder(np.kron(cells, np.ones((12, 12))), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    seen = BoardFinder(BoardSpec()).find(np.asarray(framed, np.uint8))
    assert seen is not None
    assert len(seen.ids) == 24
    assert drawing[2].attrib["d"] == "M0 0h100"
    assert "is written as .svg" in told(2, "calibrate", "camera", "--print-board", tmp_path / "b.gif")
    assert "exists" in told(2, "calibrate", "camera", "--print-board", page)
