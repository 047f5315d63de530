"""Label files: what is read of them, and what is refused in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import pytest

from flockd.ground.datasets.image_files import DatasetError
from flockd.ground.pictures.picture_files import check_size, find_pictures, read_labels

Document = dict[str, Any]


def document() -> Document:
    return {
        "info": {"year": 2026},
        "images": [
            {"id": 7, "file_name": "a.png", "width": 64, "height": 48, "license": 1},
            {"id": 8, "file_name": "sub/b.png"},
        ],
        "annotations": [
            {"id": 1, "image_id": 7, "category_id": 3, "bbox": [10, 20.5, 6, 4], "area": 24, "iscrowd": 0},
            {"id": 2, "image_id": 7, "category_id": 4, "bbox": [1, 2, 3, 4]},
        ],
        "categories": [{"id": 3, "name": "drone"}, {"id": 4, "name": "bird"}],
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With pictures, which are not opened, and no labels yet."""
    for name in ("a.png", "sub/b.png", "c.png"):
        path = tmp_path / "pictures" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


@pytest.mark.parametrize("place", ["labels.json", "pictures/labels.json"])
def test_boxes_of_drones_are_read(folder: Path, place: str) -> None:
    """File names count from the label file's folder or from the folder of the pictures; what is no drone has no box."""
    path = folder / place
    path.write_text(json.dumps(document()))
    labels = read_labels(path, find_pictures([folder / "pictures"]))
    by_name = {str(picture.relative): one for picture, one in labels.items()}
    assert {name: one.boxes for name, one in by_name.items()} == {
        "a.png": ((10.0, 20.5, 16.0, 24.5),), "sub/b.png": (),
    }  # fmt: skip
    check_size(path, "a.png", by_name["a.png"], (64, 48))
    check_size(path, "sub/b.png", by_name["sub/b.png"], (1, 1))
    with pytest.raises(DatasetError, match=r"a\.png was 64 x 48 pixels when it was labelled and is 48 x 64; label"):
        check_size(path, "a.png", by_name["a.png"], (48, 64))


def _set(*path: Any, **values: object) -> Callable[[Document], object]:
    """A change of one part of the document."""
    return lambda document: reduce(lambda part, key: part[key], path, document).update(values)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_set("annotations", 0, category_id=9), r"annotations\[0\]\.category_id: there is no category 9"),
        (_set("annotations", 1, image_id=9), r"annotations\[1\]\.image_id: there is no image 9; correct"),
        (_set("annotations", 0, bbox=[1, 2, 3]), r"annotations\[0\]\.bbox\[3\]: is missing; add it"),
        (_set("annotations", 0, bbox="1 2 3 4"), r"annotations\[0\]\.bbox: input should be .*'1 2 3 4'"),
        (_set("annotations", 0, bbox=[1, 2, 0, 4]), r"annotations\[0\]\.bbox\[2\]: input should be great"),
        (_set("annotations", 0, iscrowd=1), r"annotations\[0\]\.iscrowd: input should be 0, and not 1; correct"),
        (_set("images", 0, id="7"), r"images\[0\]\.id: input should be a valid integer, and not '7'"),
        (_set("images", 1, id=7), r"images: two have the id 7; give each its own"),
        (_set("images", 1, file_name="a.png"), r"a\.png is in the images twice; delete one"),
        (_set("images", 1, file_name="d.png"), r"d\.png is labelled and is not among the pictures; add"),
        (lambda d: d["images"][0].pop("file_name"), r"images\[0\]\.file_name: is missing; add it"),
        (lambda d: d.pop("annotations"), r"labels\.json: annotations: is missing; add it"),
        (_set(images={}), r"labels\.json: images: input should be a valid"),
        (_set("categories", 0, name="Drone"), r"categories: has Drone, bird, and the drones' must be named `drone`"),
        (b"", "is no JSON"),
        (b"\xff\xfe", "is no JSON"),
        (b"[" * 100_000, "is no JSON"),
        (b"[1, 2]", "is no COCO file; write images, annotations and categories"),
        (b'{"images": [], "annotations": [NaN], "categories": []}', "annotations"),
    ],
)
def test_wrong_labels_are_refused(folder: Path, change: Callable[[Document], object] | bytes, sentence: str) -> None:
    wrong = document()
    path = folder / "labels.json"
    if callable(change):
        change(wrong)
    path.write_bytes(change if isinstance(change, bytes) else json.dumps(wrong).encode())
    with pytest.raises(DatasetError, match=sentence) as raised:
        read_labels(path, find_pictures([folder / "pictures"]))
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)
