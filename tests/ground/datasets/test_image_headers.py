"""What an image claims to be is known, and refused, before memory is taken for it. OpenCV writes the images."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.core.jpeg_header import jpeg_end, jpeg_size
from flockd.core.messages import UInt8Array
from flockd.ground.calibration.image_sources import from_folder
from flockd.ground.datasets.image_files import DatasetError, in_order, read_image, unread
from flockd.ground.datasets.image_folder import open_dataset, read_lines
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
        MjpegFormat((side, side)).pixels(path.read_bytes())
    path.write_bytes(bytes(data))
    assert read_image(path).shape == (side, side, 3), "as an encoder writes it, it is read"


def test_what_is_no_ordinary_file_is_refused_without_waiting_for_its_writer(tmp_path: Path) -> None:
    pipe, endless = tmp_path / "pipe.png", Path("/dev/zero")
    os.mkfifo(pipe)
    for read in (read_image, read_lines):
        for path in (pipe, endless):
            with pytest.raises(DatasetError, match="is not an ordinary file"):
                read(path)


def _photograph() -> UInt8Array:
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2), np.uint8)


def test_a_jpeg_ends_at_its_end_marker_and_is_whole_or_not_read(tmp_path: Path) -> None:
    """As phones write it: a thumbnail inside, a movie behind. Data that are cut or zeroed inside decode to the end."""
    path, whole = tmp_path / "x.jpg", bytes(cv2.imencode(".jpg", _photograph())[1])
    thumbnail = b"\xff\xe1" + (2 + 4 + len(_written(".jpg"))).to_bytes(2) + b"Exif" + _written(".jpg")
    whole = whole[:2] + thumbnail + whole[2:]
    assert jpeg_end(whole) == len(whole)
    path.write_bytes(whole)
    image = read_image(path)
    for behind in (b"\xff\xd8 a movie " * 200, b"\0" * 1000, whole):
        path.write_bytes(whole + behind)
        assert np.array_equal(read_image(path), image)
    middle = len(whole) // 2 + len(thumbnail) // 2
    for inside in (whole[:middle] + b"\xff\xd9", whole[:middle] + bytes(500) + whole[middle + 500 :]):
        path.write_bytes(inside)
        with pytest.raises(DatasetError, match="is damaged inside"):
            read_image(path)
    path.write_bytes(whole[:-2])
    with pytest.raises(DatasetError, match="the JPEG ends too early"):
        read_image(path)


@pytest.mark.parametrize(("bits", "suffix"), [(10, ".png"), (12, ".tif"), (16, ".png")])
def test_the_bits_that_an_image_uses_become_eight(bits: int, suffix: str, tmp_path: Path) -> None:
    image, path = _photograph(), tmp_path / f"x{suffix}"
    image[0, 0] = 255
    cv2.imwrite(str(path), image.astype(np.uint16) << (bits - 8))
    assert np.array_equal(read_image(path), image[..., ::-1])


def test_a_thermal_image_far_above_zero_has_its_own_range(tmp_path: Path) -> None:
    """Hundredths of a kelvin, at 17 to 27 degrees: it was of one grey."""
    image = cv2.cvtColor(_photograph(), cv2.COLOR_BGR2GRAY)
    cv2.imwrite(str(tmp_path / "x.png"), 29_000 + 4 * image.astype(np.uint16))
    shown = read_image(tmp_path / "x.png")[..., 0].astype(int)
    assert np.ptp(shown) > 128
    assert np.corrcoef(shown.ravel(), image.ravel())[0, 1] > 0.99


def test_a_hot_pixel_does_not_make_an_image_of_ten_bits_black(tmp_path: Path) -> None:
    image, path = _photograph(), tmp_path / "x.png"
    ten_bits = image.astype(np.uint16) << 2
    ten_bits[60, 80] = 65535
    cv2.imwrite(str(path), ten_bits)
    image[60, 80] = 255
    assert np.array_equal(read_image(path), image[..., ::-1])


@pytest.mark.parametrize(
    ("name", "head", "told"),
    [
        ("x.jpg", b"\0\0\0\x18ftypheic", "is of a format that is not read; save it as JPEG or PNG"),
        ("x.png", b"\xff\x0a\x12", "is of a format that is not read"),
        ("x.tif", b"8BPS\0\1", "is of a format that is not read"),
        ("x.png", b"#?RADIANCE\n", "is of a format that is not read"),
        ("x.jpg", b"\0\0\0\x18ftypisom", "is a video by its contents; give its name that ending"),
        ("x.tif", b"II*\0\x08\0\0\0", "is damaged, or a kind of its format that is not read; restore it, or save"),
        ("x.jpg", b"<!DOCTYPE html>", "is a document; save its picture as PNG"),
        ("x.png", b"hello", "is no image; restore it"),
    ],
)
def test_a_good_file_of_another_kind_is_not_called_a_broken_image(
    name: str, head: bytes, told: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(head + bytes(1000))
    with pytest.raises(DatasetError, match=told):
        read_image(tmp_path / name)


def test_a_jpeg_of_twelve_bits_is_not_only_to_be_restored(tmp_path: Path) -> None:
    data = bytearray(_written(".jpg"))
    data[data.find(b"\xff\xc0") + 4] = 12
    (tmp_path / "x.jpg").write_bytes(data)
    with pytest.raises(DatasetError, match="or a kind of its format that is not read"):
        read_image(tmp_path / "x.jpg")


def test_pages_and_turns_count_by_the_contents_and_not_by_the_name(tmp_path: Path) -> None:
    image = _photograph()
    for form, name in ((".tif", "pages.jpg"), (".webp", "pages.png")):
        cv2.imwritemulti(str(tmp_path / f"x{form}"), [image, 255 - image])
        (tmp_path / f"x{form}").rename(tmp_path / name)
        with pytest.raises(DatasetError, match="has 2 pages, of which one would be read"):
            read_image(tmp_path / name)
    turned = cv2.imencode(".avif", image)[1].tobytes()
    assert read_image_of(tmp_path / "x.avif", turned).shape == (120, 160, 3)
    colour = turned.index(b"\0\0\0\x10pixi")
    with pytest.raises(DatasetError, match="is turned or mirrored by its header"):
        read_image_of(tmp_path / "x.avif", turned[:colour] + b"\0\0\0\x09irot\1" + turned[colour:])


def read_image_of(path: Path, data: bytes) -> UInt8Array:
    path.write_bytes(data)
    return read_image(path)


def _big_tiff(pages: int) -> bytes:
    """Of 32 x 32 grey pixels, by the specification of BigTIFF; all pages show the same."""
    tags = {256: 32, 257: 32, 258: 8, 259: 1, 262: 1, 273: 16, 277: 1, 278: 32, 279: 1024}
    page = struct.pack("<Q", len(tags)) + b"".join(struct.pack("<HHQQ", tag, 4, 1, n) for tag, n in tags.items())
    follow = [1040 + (k + 1) * (len(page) + 8) for k in range(pages - 1)] + [0]
    data = struct.pack("<2sHHHQ", b"II", 43, 8, 0, 1040) + bytes(range(256)) * 4
    return data + b"".join(page + struct.pack("<Q", at) for at in follow)


def test_a_big_tiff_has_pages_too(tmp_path: Path) -> None:
    assert read_image_of(tmp_path / "x.tif", _big_tiff(1)).shape == (32, 32, 3)
    with pytest.raises(DatasetError, match="has 2 pages, of which one would be read"):
        read_image_of(tmp_path / "x.tif", _big_tiff(2))


@pytest.mark.parametrize(("suffix", "begin"), [(".webp", 700), (".bmp", 1024), (".ppm", 1024), (".tif", 1024)])
def test_zeros_of_a_disk_in_place_of_an_images_data_are_known(suffix: str, begin: int, tmp_path: Path) -> None:
    """Of compressed data everywhere, of others by their sectors: black pixels are zeros too."""
    data = bytes(cv2.imencode(suffix, np.maximum(_photograph(), 1))[1])
    path = tmp_path / f"x{suffix}"
    assert read_image_of(path, data).shape == (120, 160, 3)
    with pytest.raises(
        DatasetError, match=f"holds 1024 bytes of zeros in place of data, from byte {begin} on; restore it"
    ):
        read_image_of(path, data[:begin] + bytes(1024) + data[begin + 1024 :])


def test_a_panorama_is_no_picture_of_a_lens(tmp_path: Path) -> None:
    xmp = b"http://ns.adobe.com/xap/1.0/\0<x GPano:ProjectionType='equirectangular'/>"
    data = _written(".jpg")
    with pytest.raises(DatasetError, match="is a panorama, as no lens gives it; cut a part out"):
        read_image_of(tmp_path / "x.jpg", data[:2] + b"\xff\xe1" + (len(xmp) + 2).to_bytes(2) + xmp + data[2:])


def test_what_an_image_holds_that_is_not_read_is_said(tmp_path: Path) -> None:
    path, image = tmp_path / "x.tif", _photograph()
    cv2.imwritemulti(str(path), [image, image])
    with pytest.raises(DatasetError, match="has 2 pages, of which one would be read; save each as an image"):
        read_image(path)
    cv2.imwrite(str(path), image.astype(np.float32) / 255)
    with pytest.raises(DatasetError, match="has pixels of float32; save it with 8 or 16 bits"):
        read_image(path)
    assert unread([Path(f"a/{name}") for name in ("1.HEIC", "2.heic", "3.gif", "4.mjpeg", "labels.json")]) == (
        "pictures or videos of kinds that are not read (1 .gif, 2 .heic, 1 .mjpeg); convert them to JPEG, PNG or MP4"
    )


def test_numbers_in_names_count_as_such() -> None:
    names = ["a/frame0.png", "a/frame2.png", "a/frame10.png", "b1/1.5.png", "b1/1.25.png", "b10/x.png"]
    ordered = ["a/frame0.png", "a/frame2.png", "a/frame10.png", "b1/1.25.png", "b1/1.5.png", "b10/x.png"]
    assert in_order(map(Path, names)) == list(map(Path, ordered))


def test_what_macos_lays_beside_images_is_none(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name, data in (("0.png", _written(".png", 64, 48)), ("._0.png", b"\0\5\x16\7"), ("._1.heic", b"\0\5\x16\7")):
        (images / name).write_bytes(data)
    assert [name for name, _ in from_folder(images).images] == ["0.png"]
    (tmp_path / "K.txt").write_text("60 0 31.5\n0 60 23.5\n0 0 1\n", encoding="utf-8")
    assert [frame.image.name for frame, *_ in open_dataset(tmp_path).frames(with_depth=False)] == ["0.png"]
