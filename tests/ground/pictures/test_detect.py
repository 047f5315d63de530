"""`flockd detect` as a person runs it: on rendered photographs of a known drone, and on what it cannot use."""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import signal
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.core.data import written_whole
from flockd.core.errors import UsageError
from flockd.core.messages import UInt8Array
from flockd.ground.calibration.fragment import rig_text
from flockd.ground.pictures.copies import Copies, video_file
from flockd.ground.pictures.picture_files import find_pictures
from flockd.ground.pictures.single_frame import PictureDetector, camera_with_fov
from tests import make
from tests.conftest import Told
from tests.ground.pictures.photographs import DRONE_SIZE_M, FOCAL_PX, FOV_DEG, LABELS, RENDERED, SIZE, truth
from tools.measure.labelled import read_labels, scored

Capture = pytest.CaptureFixture[str]
FOV = ("--fov", f"{FOV_DEG:g}")
NEAR, NOTHING = RENDERED / "2.5_m_0.jpg", RENDERED / "nothing.jpg"


def found_in(told: Told, *arguments: object) -> dict[str, Any]:
    result: dict[str, Any] = json.loads(told(0, "detect", *arguments, "--json"))
    return result


def test_drones_of_a_folder_are_found(told: Told) -> None:
    result = found_in(told, RENDERED, *FOV)
    assert (result["images"], result["left_out"]) == (10, [])
    assert min(result["proposals_per_image"], result["ms_per_image"]) > 0
    distances, boxes = truth()
    measured = scored(result["pictures"], read_labels(LABELS))
    assert (measured["boxes"], measured["measured"]) == (9, 10)
    assert sum(counts["found"] for counts in measured["by_width"].values()) >= 8
    assert measured["ap50"] > 0.4
    before_sky = {"2.5_m_0.jpg", "4_m_3.jpg", "6_m_6.jpg"}
    for picture in result["pictures"]:
        name = Path(picture["file"]).name
        assert picture["file"] == str(RENDERED / name)
        if name in before_sky:
            (one,) = picture["detections"]
            left, top, width, height = boxes[name]
            assert np.allclose(one["box"], (left, top, left + width, top + height), atol=8)
            assert one["range_m"] == pytest.approx(distances[name], rel=0.06)
            assert one["kind_known"] is (name != "2.5_m_0.jpg"), "the network doubts the size of that one by 3.4 %"
            assert 0 < one["range_sigma_m"] < (0.1 if one["kind_known"] else 0.9) * one["range_m"]
            assert one["size_m"] == pytest.approx(DRONE_SIZE_M, rel=0.06)


@pytest.mark.parametrize(
    ("image", "camera", "given"),
    [
        (None, {}, "not None; cv2.imread gives None for a file that it cannot read"),
        (np.zeros((360, 480), np.uint8), {}, r"not uint8 of the shape \(360, 480\)"),
        (np.zeros((360, 480, 3)), {}, r"not float64 of the shape \(360, 480, 3\)"),
        (np.zeros((360, 480, 3), np.uint8), {}, "and not both"),
        (np.zeros((360, 480, 3), np.uint8), {"camera": camera_with_fov(SIZE, FOV_DEG), "fov_deg": 70.0}, "not both"),
    ],
    ids=["not read", "grey", "floats", "no camera", "two cameras"],
)
def test_what_is_no_rgb_image_of_one_camera_is_refused(image: Any, camera: dict[str, Any], given: str) -> None:
    with pytest.raises(ValueError, match=given):
        PictureDetector().detect(image, **camera)


@pytest.mark.parametrize("fov_deg", [25.0, 90.0, 120.0, 150.0])
def test_a_field_of_view_reaches_from_border_to_border_and_keeps_a_drones_shape(fov_deg: float) -> None:
    """A small round thing is imaged nearly round: at the border of a pinhole of 120 degrees it would be 2 to 1."""
    camera = camera_with_fov((640, 480), fov_deg)
    left, right = camera.rays(np.array([[0.0, 240.0], [640.0, 240.0]]))
    assert math.degrees(math.acos(float(left @ right))) == pytest.approx(fov_deg)
    here, along, down = camera.rays(np.array([[638.0, 240.0], [639.0, 240.0], [638.0, 241.0]]))
    assert np.linalg.norm(down - here) / np.linalg.norm(along - here) < 1.42


def test_a_swarm_has_as_many_regions_looked_at_as_it_needs() -> None:
    """Twenty times the same drone, every other one mirrored; 12 regions are what a picture has at first."""
    image = np.asarray(cv2.imread(str(RENDERED / "4_m_4.jpg")), np.uint8)[158:318, 84:244, ::-1]
    row = np.concatenate([image, image[:, ::-1]] * 2 + [image], axis=1)
    result = PictureDetector().detect(np.ascontiguousarray(np.concatenate([row, row[:, ::-1]] * 2)), fov_deg=90.0)
    assert 14 <= len(result.detections) <= 20


def test_a_known_size_gives_the_range(told: Told) -> None:
    """Twice the size, twice the range; its own deviation (1 cm by default) replaces what the network says of it."""
    (free,) = found_in(told, NEAR, *FOV)["pictures"][0]["detections"]
    (known,) = found_in(told, NEAR, *FOV, "--drone-size", 2 * free["size_m"])["pictures"][0]["detections"]
    assert known["size_m"] == pytest.approx(2 * free["size_m"])
    assert known["range_m"] == pytest.approx(2 * free["range_m"], rel=0.02)
    of_size = 0.01 / (2 * free["size_m"])
    assert of_size < known["range_sigma_m"] / known["range_m"] < free["range_sigma_m"] / free["range_m"]
    assert known["box"] == pytest.approx(free["box"], abs=4)


def test_copies_show_what_was_found_and_nothing_is_lost(told: Told, tmp_path: Path) -> None:
    shutil.copy(NEAR, tmp_path / "a.jpg")
    (tmp_path / "._a.jpg").write_bytes(b"a note of another program")
    (tmp_path / ".thumbnails").mkdir()
    shutil.copy(NEAR, tmp_path / ".thumbnails" / "a.jpg")
    out = tmp_path / "drawn"
    for force in ((), ("--force",)):  # the second time, copies of before lie in the folder
        text = told(0, "detect", tmp_path, *FOV, "--out", out, *force)
        assert "{detections: 1, images: 1, " in text
    assert [path.name for path in out.rglob("*")] == ["a.jpg"]
    before, after = (cv2.imread(str(path)) for path in (tmp_path / "a.jpg", out / "a.jpg"))
    assert before is not None
    assert after is not None
    left, top, width, height = (round(value) for value in truth()[1]["2.5_m_0.jpg"])
    changed = np.abs(after.astype(int) - before).max(axis=2) > 40
    assert changed[top - 4 : top + height + 4, left - 4 : left + width + 4].mean() > 0.1
    assert changed[:, left + width + 110 :].mean() < 0.001
    assert "exists; name another with --out" in told(2, "detect", tmp_path / "a.jpg", *FOV, "--out", out)
    own = (tmp_path / "a.jpg", *FOV, "--out", tmp_path, "--force")
    assert "is one of the pictures themselves" in told(2, "detect", *own)
    told(0, "detect", tmp_path / "a.jpg", *FOV, "--out", out, "--force", "--min-probability", 1)
    again = cv2.imread(str(out / "a.jpg"))
    assert again is not None
    assert np.abs(again.astype(int) - before).max() < 40, "nothing is that probable"


def test_a_drone_of_a_video_is_followed_by_its_number(told: Told, tmp_path: Path) -> None:
    """It moves by 4 pixels a frame, and is hidden in one; the copy has each second frame, as fast as the clip."""
    clip, copy = tmp_path / "clip.avi", tmp_path / "annotated.mp4"
    seen, empty = cv2.imread(str(NEAR)), cv2.imread(str(NOTHING))
    assert seen is not None
    assert empty is not None
    writer = cv2.VideoWriter(str(clip), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE)
    for k in range(20):
        writer.write(np.roll(empty if k == 14 else seen, 4 * k, axis=1))
    writer.release()
    result = found_in(told, clip, *FOV, "--every", 2, "--out", copy)
    frames = result["pictures"]
    assert [picture["file"] for picture in frames] == [f"{clip}#{k}" for k in range(0, 20, 2)]
    assert not any(picture["detections"] for picture in frames[:3]), "it is shown for half a second first"
    left, _, width, _ = truth()[1]["2.5_m_0.jpg"]
    for k, picture in enumerate(frames[3:], start=3):
        (one,) = picture["detections"]
        assert (one["drone"], one["seen"]) == (1, k != 7)
        assert (one["box"][0] + one["box"][2]) / 2 == pytest.approx(left + width / 2 + 8 * k, abs=8)
    (drone,) = result["drones_of_videos"]
    assert (drone["drone"], drone["frames"], drone["first_s"], drone["last_s"]) == (1, 6, 0.6, 1.8)
    video = cv2.VideoCapture(str(copy))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (10, 5)
    drawn = [video.read()[1].astype(int) for _ in range(10)]
    original = [np.roll(seen, 8 * k, axis=1).astype(int) for k in range(10)]
    changed = [float((np.abs(a - b).max(axis=2) > 60).mean()) for a, b in zip(drawn, original, strict=True)]
    assert max(changed[:3]) < 0.001
    assert min(changed[3:]) > 0.01
    text = told(0, "detect", clip, *FOV, "--every", 2, "--out", copy, "--force").splitlines()
    assert text[0].split() == ["video", "drone", "seen,", "s", "frames", "probability", "range,", "m", "size,", "m"]
    assert text[1].split()[:4] == ["clip.avi", "1", "0.6-1.8", "6"]
    assert "exists; name another with --out" in told(2, "detect", clip, *FOV, "--out", copy)
    assert "is the name of one video" in told(2, "detect", clip, NEAR, *FOV, "--out", tmp_path / "both.mp4")
    told(0, "detect", clip, *FOV, "--every", 9, "--out", tmp_path / "drawn")
    assert [path.name for path in (tmp_path / "drawn").iterdir()] == ["clip.mp4"]


@pytest.mark.parametrize("name", ["a.mp4", "a.jpg"])
def test_an_interrupted_copy_leaves_the_one_before(tmp_path: Path, name: str) -> None:
    source, out = tmp_path / name, tmp_path / "drawn"
    video = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, SIZE)
    video.write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    video.release()
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    out.mkdir()
    (out / name).write_text("before")
    (picture,) = find_pictures([source])
    copies = Copies(out, [picture], overwrite=True)
    with pytest.raises(KeyboardInterrupt), copies.of(picture, 1) as write:
        write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
        raise KeyboardInterrupt
    assert [path.name for path in out.iterdir()] == [name]
    assert (out / name).read_text() == "before"
    with copies.of(picture, 1) as write:
        write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    assert [path.name for path in out.iterdir()] == [name]
    assert (out / name).stat().st_size > 100


def test_a_video_that_a_full_disk_cuts_off_is_not_kept(tmp_path: Path) -> None:
    """A limit of the file's size stands for the disk. FFmpeg reports neither."""
    target, noise = tmp_path / "a.mp4", np.random.default_rng(0)
    images = noise.integers(0, 255, (10, 240, 320, 3), dtype=np.uint8)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
        with pytest.raises(UsageError, match=r"a\.mp4: cannot be written whole, as on a full disk; make room"):
            write_video(target, images)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert list(tmp_path.iterdir()) == []
    write_video(target, images)
    assert target.stat().st_size > 100_000, "the limit was too large to test anything"


def write_video(target: Path, images: UInt8Array) -> None:
    with written_whole(target) as draft, video_file(draft, target, 10.0) as write:
        for image in images:
            write(image)


def drone_file(path: Path, cameras: tuple[str, ...] = ("front",)) -> Path:
    mounted = [make.camera(name, SIZE, FOCAL_PX, yaw_deg=90.0 * k) for k, name in enumerate(cameras)]
    path.write_text(rig_text(mounted, ()), encoding="utf-8")
    return path


def test_a_drones_own_camera_is_taken(told: Told, tmp_path: Path) -> None:
    config = drone_file(tmp_path / "drone.yaml", ("front", "left"))
    by_fov, by_config = (
        found_in(told, NEAR, *options)["pictures"][0]["detections"][0]
        for options in (FOV, ("--config", config, "--camera", "left"))
    )
    assert by_config["range_m"] == pytest.approx(by_fov["range_m"], rel=0.01)
    assert by_config["box"] == pytest.approx(by_fov["box"], abs=1)
    assert "has several cameras; choose with --camera from front, left" in told(2, "detect", NEAR, "--config", config)
    other = ("--config", config, "--camera", "right")
    assert "has no camera 'right'; choose with --camera from front, left" in told(2, "detect", NEAR, *other)
    assert cv2.imwrite(str(tmp_path / "small.png"), np.zeros((60, 80, 3), np.uint8))
    small = (tmp_path / "small.png", "--config", config, "--camera", "left")
    assert "is 80 x 60 pixels, and the camera of" in told(2, "detect", *small)


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        ((NEAR,), 2, "the pictures' camera is not known; give its field of view with --fov"),
        ((NEAR, *FOV, "--camera", "front"), 2, "--camera is one of --config's, in place of --fov"),
        ((NEAR, *FOV, "--force"), 2, "--force has no meaning without --out"),
        ((LABELS, *FOV), 2, "drones.json: is not an image or a video by its name"),
        ((NEAR, *FOV, "--out", "drawn.jpg"), 2, "drawn.jpg: is not a folder; name one with --out, or a video"),
        ((NEAR, *FOV, "--out", "drawn.avi"), 2, "drawn.avi: is not a folder; name one with --out, or a video"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(
    told: Told, arguments: tuple[object, ...], code: int, sentence: str
) -> None:
    assert sentence in told(code, "detect", *arguments)


@pytest.mark.parametrize("size_m", ["0.01", "35"])
def test_a_size_that_no_drone_has_is_refused(capsys: Capture, size_m: str) -> None:
    with pytest.raises(SystemExit):
        main(["detect", str(NEAR), *FOV, "--drone-size", size_m])
    assert f"argument --drone-size: '{size_m}' is not a size in metres, 0.05 to 5" in capsys.readouterr().err


def _animated() -> bytes:
    """A PNG that says that it has two frames."""
    png = cv2.imencode(".png", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    control = b"acTL" + struct.pack(">II", 2, 0)
    header = 33  # bytes of the signature and IHDR
    return png[:header] + struct.pack(">I", 8) + control + struct.pack(">I", zlib.crc32(control)) + png[header:]


def test_links_to_nothing_and_pipes_among_pictures_are_named(capsys: Capture, told: Told, tmp_path: Path) -> None:
    shutil.copy(NEAR, tmp_path / "near.jpg")
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    assert main(["detect", str(tmp_path), *FOV]) == 1
    named = (
        f"left out: {tmp_path}: gone.jpg, which is a link to nothing, or not an ordinary file; restore or delete it\n"
    )
    assert named in capsys.readouterr().err
    (tmp_path / "near.jpg").unlink()
    os.mkfifo(tmp_path / "pipe.png")
    said = told(2, "detect", tmp_path, *FOV)
    assert "gone.jpg, which" in said
    assert "pipe.png, which" in said


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.jpg", b"", "is empty"),
        ("a.jpg", b"no picture", "is no image"),
        ("a.png", b"GIF89a" + bytes(99), "is of a format that is not read; save it as JPEG or PNG"),
        ("a.jpg", b"version https://git-lfs.github.com/spec/v1\noid", "is a pointer of Git LFS; fetch the file with"),
        ("a.png", _animated(), "has 2 pages, of which one would be read; save each as an image"),
        ("a.jpg", b"P6\n60000 60000\n255\n", "has more pixels than any camera, or none"),
        ("a.ppm", b"P6\n40 31\n255\n" + bytes(40 * 31 * 3), "is 40 x 31 pixels, and 32 x 32 are needed"),
        ("a.mp4", b"no video", "cannot be decoded as a video"),
    ],
    ids=["empty", "text", "GIF", "LFS", "animated", "huge PPM", "small", "video"],
)
def test_a_picture_that_cannot_be_read_ends_it(
    told: Told, tmp_path: Path, name: str, content: bytes, sentence: str
) -> None:
    (tmp_path / name).write_bytes(content)
    assert f"{tmp_path / name}: {sentence}" in told(1, "detect", tmp_path, *FOV)


def test_one_truncated_picture_among_others_is_left_out_and_said(capsys: Capture, tmp_path: Path) -> None:
    """The others are searched, and copied, as without it; the exit code says that one is missing."""
    for name in ("a.jpg", "c.jpg"):
        shutil.copy(NEAR, tmp_path / name)
    (tmp_path / "b.jpg").write_bytes(NEAR.read_bytes()[:9000])
    assert main(["detect", str(tmp_path), *FOV, "--json", "--out", str(tmp_path / "drawn")]) == 1
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert [Path(picture["file"]).name for picture in result["pictures"]] == ["a.jpg", "c.jpg"]
    fault = f"{tmp_path / 'b.jpg'}: the JPEG ends too early; restore it, or leave its frame out"
    assert result["left_out"] == [fault]
    assert captured.err.splitlines()[-2:] == [f"written: 2 copies in {tmp_path / 'drawn'}", f"left out: {fault}"]
    assert sorted(path.name for path in (tmp_path / "drawn").iterdir()) == ["a.jpg", "c.jpg"]


def test_a_phones_picture_is_turned_as_it_was_held(told: Told, tmp_path: Path) -> None:
    """EXIF orientation 6: the sensor's image is to be turned to the right for showing."""
    plain = cv2.imread(str(NEAR))
    assert plain is not None
    _, jpeg = cv2.imencode(".jpg", cv2.rotate(plain, cv2.ROTATE_90_COUNTERCLOCKWISE))
    tag = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    data = jpeg.tobytes()
    path = tmp_path / "held.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(tag) + 2) + tag + data[2:])
    (turned,) = found_in(told, path, *FOV)["pictures"][0]["detections"]
    left, top, width, height = truth()[1]["2.5_m_0.jpg"]
    assert np.allclose(turned["box"], (left, top, left + width, top + height), atol=8)


def test_a_video_that_is_damaged_in_the_middle_is_told_with_how_much_was_read(
    capsys: Capture, told: Told, tmp_path: Path
) -> None:
    """Its second half is zeros; what a folder holds of kinds that are not read is named beside it."""
    video = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE)
    image = np.asarray(cv2.imread(str(NOTHING)), np.uint8)
    for _ in range(12):
        writer.write(image)
    writer.release()
    assert found_in(told, video, *FOV)["images"] == 12
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    (tmp_path / "1.heic").touch()
    capsys.readouterr()
    assert main(["detect", str(tmp_path), *FOV, "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    kinds, damage = result["left_out"]
    assert "kinds that are not read (1 .heic)" in kinds
    assert f"{video}: is damaged: {result['images']} of its 12 frames were read" in damage
    assert 3 <= result["images"] <= 7


def test_a_video_without_its_beginning_is_refused(told: Told, tmp_path: Path) -> None:
    """FFmpeg finds frames in it, and makes up their times."""
    video = tmp_path / "clip.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, SIZE)
    for image in np.random.default_rng(0).integers(0, 255, (6, *SIZE[::-1], 3), np.uint8):
        writer.write(image)
    writer.release()
    data = video.read_bytes()
    video.write_bytes(data[len(data) // 2 :])
    assert f"{video}: lacks its beginning, or its list of frames; restore it" in told(1, "detect", video, *FOV)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda x, y, w, h: [x, y, x + w, y + h], "ends outside it; write left, top, width, height, not the corners"),
        (lambda x, y, w, h: [x / 480, y / 360, w / 480, h / 360], "is in shares of it; write pixels"),
        (lambda x, y, w, h: [x, y, -w, h], "ends outside it"),
        (lambda x, y, w, h: [x, y, math.nan, h], "ends outside it"),
    ],
)
def test_labels_that_cannot_be_of_the_pictures_are_refused(change: Any, fault: str, tmp_path: Path) -> None:
    labels = json.loads(LABELS.read_text())
    for one in labels["images"]:
        one["file_name"] = str(LABELS.parent / one["file_name"])
    labels["categories"] = [{"id": 7, "name": "Drone "}, {"id": 1, "name": "drone"}, {"id": 2, "name": "bird"}]
    labels["annotations"][0]["category_id"] = 7
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(labels), encoding="utf-8-sig")
    whole = read_labels(path)
    assert sum(map(len, whole.values())) == 9, "of categories in whatever letters, behind a byte order mark"
    for one in labels["annotations"]:
        one["bbox"] = change(*one["bbox"])
    path.write_text(json.dumps(labels), encoding="utf-8")
    with pytest.raises(SystemExit, match=fault):
        read_labels(path)
    labels["images"][0] |= {"width": 960, "height": 720}
    path.write_text(json.dumps(labels), encoding="utf-8")
    with pytest.raises(SystemExit, match="is of 480 x 360 pixels, upright, and its labels of 960 x 720; "):
        read_labels(path)
    labels["images"][1]["id"] = 1
    path.write_text(json.dumps(labels), encoding="utf-8")
    with pytest.raises(SystemExit, match="names a picture or an id of one twice"):
        read_labels(path)
    labels["categories"] = [{"id": 1, "name": "quadcopter"}]
    path.write_text(json.dumps(labels), encoding="utf-8")
    with pytest.raises(SystemExit, match="has no category `drone`, but quadcopter"):
        read_labels(path)


def test_pictures_without_colour_are_told(capsys: Capture, told: Told, tmp_path: Path) -> None:
    """As a thermal camera gives them; a grey sky has some colour still."""
    image = cv2.imread(str(NEAR))
    assert image is not None
    grey = np.repeat(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None], 3, axis=2)
    tinted = grey + np.array([0, 0, 2], np.uint8)
    for name, picture in (("grey.jpg", grey), ("tinted.png", tinted), ("colour.png", image)):
        cv2.imwrite(str(tmp_path / name), picture)
    cv2.imwrite(str(tmp_path / "covered.png"), np.zeros_like(image))
    assert main(["detect", str(tmp_path), *FOV, "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["without_colour"] == 1
    assert "1 of 4 of one colour all over; uncover the lens, or give other pictures\n1 of 4 without" in captured.err
    assert "without colour" not in told(0, "detect", NEAR, *FOV)
