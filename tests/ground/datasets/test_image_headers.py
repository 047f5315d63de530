"""What an image claims to be is known, and refused, before memory is taken for it. OpenCV writes the images."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.core.jpeg_header import jpeg_size
from flockd.ground.datasets.image_files import DatasetError, read_image
from flockd.ground.datasets.image_folder import read_lines
from flockd.ground.pictures.picture_files import read_labels
from flockd.onboard.sources.image_formats import CorruptImageError, MjpegFormat

HUGE = 60_000


def _written(suffix: str, width: int = 37, height: int = 21, channels: int = 3) -> bytes:
    shape = (height, width, channels) if channels > 1 else (height, width)
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data)


def _claiming(suffix: str) -> bytes:
    """An image whose header was changed to say 60000 x 60000."""
    small, huge = (37, 21), HUGE
    data = bytearray(_written(suffix))
    match suffix:
        case ".bmp":
            data[18:26] = huge.to_bytes(4, "little") * 2
        case ".ppm":
            data = bytearray(data.replace(b"37 21", b"60000 60000", 1))
        case ".tif":
            at = int.from_bytes(data[4:8], "little")
            for entry in range(at + 2, at + 2 + 12 * int.from_bytes(data[at : at + 2], "little"), 12):
                if int.from_bytes(data[entry : entry + 2], "little") in {256, 257}:
                    data[entry + 2 : entry + 4] = (4).to_bytes(2, "little")
                    data[entry + 8 : entry + 12] = huge.to_bytes(4, "little")
        case ".jpg":
            at = data.index(small[1].to_bytes(2) + small[0].to_bytes(2))
            data[at : at + 4] = huge.to_bytes(2) * 2
        case _:
            data[16:24] = huge.to_bytes(4) * 2
            import zlib

            data[29:33] = zlib.crc32(data[12:29]).to_bytes(4)
    return bytes(data)


SUFFIXES = (".png", ".jpg", ".bmp", ".ppm", ".tif")


def test_the_size_is_that_which_was_written() -> None:
    data = _written(".jpg")
    assert jpeg_size(data) == (37, 21)
    for end in range(0, len(data), 7):
        assert jpeg_size(data[:end]) in {None, (37, 21)}
    assert jpeg_size(_written(".png")) is None


def told_of_huge(suffix: str) -> str:
    """JPEGs are measured here, others by OpenCV."""
    of_others = "has more pixels than any camera, or none"
    return "claims to be 60000 x 60000 pixels, more than any camera has" if suffix == ".jpg" else of_others


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_image_that_claims_to_be_huge_is_refused_before_it_is_decoded(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"huge{suffix}"
    path.write_bytes(_claiming(suffix))
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError) as refused:
            read_image(path)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert str(refused.value) == f"{path}: {told_of_huge(suffix)}; restore it, or leave its frame out"
    assert most < 5e6


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".pgm"])
def test_an_ordinary_image_is_read_as_before(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"image{suffix}"
    path.write_bytes(_written(suffix, channels=1 if suffix == ".pgm" else 3))
    np.testing.assert_array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_COLOR_RGB))


def _with_scans(data: bytes, scans: int) -> bytes:
    """A progressive JPEG whose last scan comes so many times more."""
    begin = data.rfind(b"\xff\xc4", 0, data.rfind(b"\xff\xda"))
    return data[:-2] + data[begin:-2] * scans + data[-2:]


@pytest.mark.parametrize(("side", "scans"), [(4096, 7_000), (4096, 80), (64, 7_000)])
def test_a_jpeg_that_takes_long_for_its_many_scans_is_refused_before_it_is_decoded(
    side: int, scans: int, tmp_path: Path
) -> None:
    """0.46 MB of 4096 x 4096 pixels take a minute and a half. Each scan goes over all pixels."""
    plain = np.full((side, side), 128, np.uint8)
    done, data = cv2.imencode(".jpg", plain, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert done
    path = tmp_path / "slow.jpg"
    path.write_bytes(_with_scans(bytes(data), scans))
    own = bytes(data).count(b"\xff\xda")
    with pytest.raises(DatasetError) as refused:
        read_image(path)
    told = f"{path}: has {own + scans} scans of {side} x {side} pixels, more than any camera writes; "
    assert str(refused.value).startswith(told)
    with pytest.raises(CorruptImageError, match="scans of"):
        MjpegFormat((side, side)).decode(path.read_bytes())
    path.write_bytes(bytes(data))
    assert read_image(path).shape == (side, side, 3), "as an encoder writes it, it is read"


def test_a_pipe_is_refused_without_waiting_for_its_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(DatasetError, match=r"pipe\.png: is not an ordinary file"):
        read_image(tmp_path / "pipe.png")
    with pytest.raises(DatasetError, match="is not an ordinary file"):
        read_image(Path("/dev/zero"))


def test_a_table_or_a_list_of_labels_that_is_a_pipe_is_refused_too(tmp_path: Path) -> None:
    pipe = tmp_path / "poses.txt"
    os.mkfifo(pipe)
    with pytest.raises(DatasetError, match=r"poses\.txt: is not an ordinary file"):
        read_lines(pipe)
    with pytest.raises(DatasetError, match=r"poses\.txt: is not an ordinary file"):
        read_labels(pipe, [])
    (tmp_path / "endless.txt").symlink_to("/dev/zero")
    with pytest.raises(DatasetError, match=r"endless\.txt: is not an ordinary file"):
        read_lines(tmp_path / "endless.txt")


def test_a_calibration_from_such_an_image_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = tmp_path / "images"
    images.mkdir()
    (images / "one.jpg").write_bytes(_claiming(".jpg"))
    assert main(["calibrate", "camera", str(images), "--out", str(tmp_path / "lens.yaml")]) == 1
    told = capsys.readouterr().err
    assert "one.jpg: claims to be 60000 x 60000 pixels" in told
