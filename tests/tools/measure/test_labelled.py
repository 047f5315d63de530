"""How detections in labelled pictures are matched and measured: every figure by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tools.measure.labelled import Box, average_precision, half_overlap, main, match, middle_inside, read_labels, scored

BOX = (10.0, 10.0, 30.0, 20.0)


def moved(right: float) -> Box:
    return BOX[0] + right, BOX[1], BOX[2] + right, BOX[3]


def test_of_two_boxes_a_detection_takes_the_one_that_it_fits_best_and_each_is_found_once() -> None:
    wide = (0.0, 0.0, 60.0, 40.0)
    assert match([BOX, (25.0, 15.0, 45.0, 35.0)], [wide, BOX], middle_inside) == [1, 0]
    assert match([BOX, (25.0, 15.0, 45.0, 35.0)], [wide, BOX], half_overlap) == [1, None]
    assert half_overlap(moved(6), BOX) == pytest.approx(14 / 26)
    assert half_overlap(moved(7), BOX) == -1.0, "13 / 27"
    assert match([moved(2), BOX, moved(50)], [BOX, (100.0, 100.0, 110.0, 105.0)], middle_inside) == [0, None, None]


def test_average_precision_by_hand() -> None:
    """Three boxes: hit, miss, hit. Precision 1 at recall 1/3, 2/3 at 2/3: area 1/3 + 2/9. The third is not found."""
    assert average_precision([(0.7, True), (0.9, True), (0.8, False)], 3) == pytest.approx(1 / 3 + 2 / 9)
    # At each recall the best precision from there on counts: 2/3 at both hits after a miss.
    assert average_precision([(0.9, False), (0.8, True), (0.7, True)], 2) == pytest.approx(2 / 3)
    assert average_precision([], 3) == 0.0
    assert average_precision([(0.9, False)], 0) is None
    # A miss before the hit costs it: precision is 1/2 at recall 1. Of equal probabilities none is before the other.
    assert average_precision([(0.9, False), (0.8, True)], 1) == pytest.approx(0.5)
    assert average_precision([(0.9, True), (0.9, False)], 1) == average_precision([(0.9, False), (0.9, True)], 1) == 0.5


def test_pictures_with_and_without_drones_and_one_without_labels(tmp_path: Path) -> None:
    """Boxes 20 px wide: hit well; hit with IoU 1/3, beside a false one; not found; and a false one where none is."""
    ghost = (200.0, 200.0, 230.0, 220.0)
    left, top, right, bottom = BOX
    labels = {
        "images": [{"id": number, "file_name": f"{number}.jpg"} for number in range(4)],
        "categories": [{"id": 1, "name": "bird"}, {"id": 2, "name": "drone"}],
        "annotations": [
            {"image_id": number, "category_id": kind, "bbox": [left, top, right - left, bottom - top]}
            for number, kind in ((0, 2), (1, 2), (2, 2), (3, 1))
        ],
    }
    (tmp_path / "labels.json").write_text(json.dumps(labels))

    def picture(name: str, *found: tuple[Box, float]) -> dict[str, Any]:
        return {"file": str(tmp_path / name), "detections": [{"box": b, "probability": p} for b, p in found]}

    pictures = [
        picture("0.jpg", (BOX, 0.99)), picture("1.jpg", (moved(9.9), 0.9), (ghost, 0.95)), picture("2.jpg"),
        picture("3.jpg", (ghost, 0.85)), picture("other.jpg", (BOX, 0.9)),
    ]  # fmt: skip
    found = scored(pictures, read_labels(tmp_path / "labels.json"))
    assert found["by_width"].pop("12-30") == {"boxes": 3, "found": 2}
    assert set(map(str, found.pop("by_width").values())) == {"{'boxes': 0, 'found': 0}"}
    assert found.pop("unmeasured") == 0
    assert found == {"boxes": 3, "ap50": round(1 / 3, 4), "measured": 4, "false": 2, "false_per_picture": 0.5}


NO_PICTURES = '{"categories": [{"id": 1, "name": "drone"}], "images": [], "annotations": []}'


ONE_BOX = '{"image_id": 1, "category_id": 1, "bbox": [1, 1, 9, 9]}'
A_BOX = NO_PICTURES.replace('"images": []', '"images": [{"id": 1, "file_name": "a.png"}]').replace(
    '"annotations": []', f'"annotations": [{ONE_BOX}]'
)


def test_labelled_pictures_in_which_nothing_was_detected_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As with names of another system, C:\\a.png: the figures were of the others alone."""
    labels = A_BOX.replace('"images": [', '"images": [{"id": 2, "file_name": "b.png"}, ')
    (tmp_path / "labels.json").write_text(labels)
    found = {"pictures": [{"file": str(tmp_path / "a.png"), "detections": []}]}
    (tmp_path / "found.json").write_text(json.dumps(found))
    monkeypatch.setattr("sys.argv", ["labelled", *(str(tmp_path / name) for name in ("found.json", "labels.json"))])
    main()
    assert f"1 of 2 pictures of {tmp_path}/labels.json are not in {tmp_path}/found.json; det" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("found", "labels", "told"),
    [
        ('{"pictures": []}', "{}", "labels.json: lacks 'categories'; give boxes in COCO's format"),
        ("[]", NO_PICTURES, "found.json: is of another form; give what"),
        ("pictures", NO_PICTURES, "found.json: is no JSON; give what"),
        ('{"pictures": [{"file": "FOLDER/a.png"}]}', A_BOX, "found.json: lacks 'detections'; give what"),
        ('{"pictures": []}', "0 0.5 0.5 0.1 0.1", "labels.json: is no JSON; give boxes in COCO's format"),
        (
            '{"pictures": []}',
            A_BOX.replace('ry_id": 1', 'ry_id": 0'),
            "of category 0: its category or image is not listed",
        ),
        ('{"pictures": []}', A_BOX.replace('ge_id": 1', 'ge_id": 2'), "image 2: .*its category or image is not listed"),
        ('{"pictures": []}', A_BOX.replace(", 9]", "]"), "of category 1 is no box; write left, top, width, height"),
        ('{"pictures": []}', A_BOX.replace(ONE_BOX, f"{ONE_BOX}, {ONE_BOX}"), "is there twice; delete one"),
        ('{"pictures": []}', NO_PICTURES, "found.json: has none of the pictures of "),
    ],
)
def test_what_cannot_be_measured_is_told_in_a_sentence(
    found: str, labels: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / "found.json", tmp_path / "labels.json"]
    for file, text in zip(files, (found, labels), strict=True):
        file.write_text(text.replace("FOLDER", str(tmp_path)), encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["labelled", *map(str, files)])
    with pytest.raises(SystemExit, match=told):
        main()
