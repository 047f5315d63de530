"""What an image claims to be is known, and refused, before memory is taken for it. OpenCV writes the images."""

from __future__ import annotations

import os
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.core.jpeg_header import jpeg_size
from flockd.ground.datasets.image_files import DatasetError, read_image
from flockd.ground.datasets.image_folder import read_lines
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
    data = bytearray(_written(suffix))
    if suffix == ".jpg":
        at = data.index((21).to_bytes(2) + (37).to_bytes(2))
        data[at : at + 4] = HUGE.to_bytes(2) * 2
    else:
        data[16:24] = HUGE.to_bytes(4) * 2
        data[29:33] = zlib.crc32(data[12:29]).to_bytes(4)
    return bytes(data)


def test_the_size_is_that_which_was_written() -> None:
    data = _written(".jpg")
    assert jpeg_size(data) == (37, 21)
    for end in range(0, len(data), 7):
        assert jpeg_size(data[:end]) in {None, (37, 21)}
    assert jpeg_size(_written(".png")) is None


@pytest.mark.parametrize(
    ("suffix", "told"), [(".jpg", "claims to be 60000 x 60000 pixels"), (".png", "has more pixels than any camera")]
)
def test_an_image_that_claims_to_be_huge_is_refused_before_it_is_decoded(
    suffix: str, told: str, tmp_path: Path
) -> None:
    """JPEGs are measured here, others by OpenCV."""
    path = tmp_path / f"huge{suffix}"
    path.write_bytes(_claiming(suffix))
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=told):
            read_image(path)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".tif", ".pgm"])
def test_an_ordinary_image_is_read_as_before(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"image{suffix}"
    path.write_bytes(_written(suffix, channels=1 if suffix == ".pgm" else 3))
    np.testing.assert_array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_COLOR_RGB))


@pytest.mark.parametrize(("side", "scans"), [(4096, 7_000), (4096, 80), (64, 7_000)])
def test_a_jpeg_that_takes_long_for_its_many_scans_is_refused_before_it_is_decoded(
    side: int, scans: int, tmp_path: Path
) -> None:
    """0.46 MB of 4096 x 4096 pixels take a minute and a half. Each scan goes over all pixels."""
    plain = np.full((side, side), 128, np.uint8)
    done, data = cv2.imencode(".jpg", plain, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert done
    path = tmp_path / "slow.jpg"
    begin = bytes(data).rfind(b"\xff\xc4", 0, bytes(data).rfind(b"\xff\xda"))  # its last scan, so many times more
    path.write_bytes(bytes(data)[:-2] + bytes(data)[begin:-2] * scans + bytes(data)[-2:])
    with pytest.raises(DatasetError, match=rf"scans of {side} x {side} pixels, more than any camera writes"):
        read_image(path)
    with pytest.raises(CorruptImageError, match="scans of"):
        MjpegFormat((side, side)).decode(path.read_bytes())
    path.write_bytes(bytes(data))
    assert read_image(path).shape == (side, side, 3), "as an encoder writes it, it is read"


def test_what_is_no_ordinary_file_is_refused_without_waiting_for_its_writer(tmp_path: Path) -> None:
    pipe, endless = tmp_path / "pipe.png", Path("/dev/zero")
    os.mkfifo(pipe)
    for read in (read_image, read_lines):
        for path in (pipe, endless):
            with pytest.raises(DatasetError, match="is not an ordinary file"):
                read(path)
