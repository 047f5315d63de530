"""A camera's bytes become the picture it took, or are refused."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.onboard.sources.image_formats import CorruptImageError, MjpegFormat, PackedFormat, RgbFormat, plausible
from tests.onboard.sources.camera_images import SIZE, jpeg, scene


def _without_huffman_tables(data: bytes) -> bytes:
    at, out = 2, data[:2]
    while data[at + 1] != 0xDA:
        length = 2 + int.from_bytes(data[at + 2 : at + 4])
        if data[at + 1] != 0xC4:
            out += data[at : at + length]
        at += length
    return out + data[at:]


def test_a_jpeg_may_leave_out_the_tables_that_all_cameras_share_and_be_padded() -> None:
    whole = jpeg(scene())
    bare = _without_huffman_tables(whole)
    assert len(bare) < len(whole) - 400
    for padding in (bytes(513), b"\xff\xff\x55" * 171):  # whatever the driver's buffer held
        np.testing.assert_array_equal(MjpegFormat(SIZE).pixels(bare + padding), MjpegFormat(SIZE).pixels(whole))


@pytest.mark.fault("damaged-images")
@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: b"", "no JPEG begins here"),
        (lambda data: data[: len(data) // 2], "JPEG ends too early"),
        (lambda data: data[2:], "no JPEG begins here"),
        (lambda data: data[:2] + data[-2:], "JPEG has no size"),
        (lambda data: data[:200] + b"\xff\xd9", "JPEG has|JPEG cannot be decoded"),
        (lambda data: jpeg(scene()[::2, ::2]), "JPEG has 320x240 instead of 640x480"),
        (lambda data: data[: len(data) // 2] + b"\xff\xd9", "the image's last rows are missing"),
        (lambda data: jpeg(np.full((480, 640, 3), 128, np.uint8)), "all of one colour"),
    ],
)
def test_a_damaged_jpeg_is_refused_with_a_reason(damage: object, reason: str) -> None:
    assert callable(damage)
    with pytest.raises(CorruptImageError, match=reason):
        plausible(MjpegFormat(SIZE).pixels(damage(jpeg(scene()))))


def test_a_white_sky_and_a_black_ground_are_no_damage() -> None:
    image = scene()
    image[:200] = 255
    image[400:] = 0
    assert plausible(MjpegFormat(SIZE).pixels(jpeg(image))).shape == (480, 640, 3)


def test_whole_pixels_are_reduced_to_their_mean() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    reduced = PackedFormat("RGB", (64, 48), reduce=2).pixels(pixels.tobytes())
    np.testing.assert_allclose(reduced, pixels.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3)), atol=1.0)


def test_plain_rgb_is_handed_on_as_it_is_even_if_it_shows_nothing() -> None:
    for image in (scene(), np.zeros((480, 640, 3), np.uint8)):
        np.testing.assert_array_equal(RgbFormat(SIZE).pixels(image.tobytes()), image)
    with pytest.raises(CorruptImageError, match="921599 bytes instead of 921600"):
        RgbFormat(SIZE).pixels(scene().tobytes()[:-1])
