"""Data sets and images that were changed anywhere."""

from __future__ import annotations

import itertools
from pathlib import Path
from random import Random

import cv2
import numpy as np

from flockd.ground.datasets.image_files import read_image
from flockd.ground.datasets.image_folder import open_dataset
from tests.hostile import hostile, mutated_bytes, odd_file, own_errors, put, removed, text_of

MOST_FRAMES = 50
"""Read of a mutated data set."""


def test_a_changed_data_set_is_read_or_refused(tmp_path: Path) -> None:
    root = _folder(tmp_path)
    originals = {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}

    @hostile(80)
    def check(random: Random) -> None:
        touched = random.sample(list(originals), random.choice((1, 1, 2)))
        try:  # Hypothesis may end an input at any choice
            for path in touched:
                original = originals[path]
                is_text = path.suffix in {".txt"}
                if random.random() < 0.02:
                    odd_file(random, path)
                else:
                    path.write_bytes(
                        text_of(random, [original.decode()]) if is_text else mutated_bytes(random, original)
                    )
            with own_errors():
                dataset = open_dataset(root)
                for _ in itertools.islice(dataset.frames(with_depth=dataset.has_depth), MOST_FRAMES):
                    pass
        finally:
            for path in touched:
                removed(path)
                path.write_bytes(originals[path])

    check()


def test_a_changed_image_is_decoded_or_refused(tmp_path: Path) -> None:
    """What a decoder would take long for, or much memory, beside what is damaged."""
    rows, columns = np.mgrid[0:240, 0:320]
    pixels = np.stack([rows, columns % 256, (rows * columns) % 256], axis=2).astype(np.uint8)
    suffixes = (".jpg", ".png", ".bmp", ".ppm", ".tif")
    written = [(suffix, cv2.imencode(suffix, pixels)[1].tobytes()) for suffix in suffixes]
    progressive = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    sized = progressive.index(b"\xff\xc2") + 5

    @hostile(15)
    def check(random: Random) -> None:
        suffix, data = random.choice((*written, (".jpg", progressive), (".jpg", progressive)))
        if data is progressive:
            if random.random() < 0.5:
                side = random.choice((64, 1000, 4096, 8000, 8192, 20_000, 65_535)).to_bytes(2)
                data = data[:sized] + side + side + data[sized + 4 :]
            if random.random() < 0.7:
                data = _with_scans(random, data)
        if random.random() < 0.6:
            data = mutated_bytes(random, data)
        path = tmp_path / f"image{suffix}"
        put(random, path, lambda: data)
        with own_errors():
            assert read_image(path).shape[2] == 3
        removed(path)

    check()


def _with_scans(random: Random, data: bytes) -> bytes:
    """With one of its scans, and its tables, some times more."""
    scans = [at for at in range(len(data)) if data.startswith(b"\xff\xda", at)]
    which = random.randrange(len(scans))
    begin = max(data.rfind(b"\xff\xc4", 0, scans[which]), 0)
    end = scans[which + 1] if which + 1 < len(scans) else len(data) - 2
    return data[:end] + data[begin:end] * random.choice((1, 10, 90, 500, 5_000)) + data[end:]


def _image(path: Path, *, depth: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = np.mgrid[0:12, 0:16]
    pixels = (rows * 20 + columns) * (100 if depth else 1)
    cv2.imwrite(str(path), pixels.astype(np.uint16 if depth else np.uint8))


def _folder(root: Path) -> Path:
    for index in range(3):
        _image(root / f"images/{index}.png")
        _image(root / f"depth/{index}.png", depth=True)
    (root / "K.txt").write_text("10 0 8\n0 10 6\n0 0 1\n")
    (root / "poses.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0 0 0 0 1\n" for i in range(3)))
    return root
