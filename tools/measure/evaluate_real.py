"""Measure single-frame detection on real pictures, and print one table.

python -m tools.measure.evaluate_real --labelled towns=FOLDER --without-drones office=FOLDER [--json]

A labelled folder holds pictures and `labels.json`, boxes in COCO's format; `flockd detect --labels` measures one such.
Pictures of the other folders hold no drone: all that is found there is false.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.ground.pictures import Labelled, PictureDetector, PictureFile, find_pictures, summary
from flockd.ground.pictures.coco_labels import read_labels
from flockd.ground.pictures.scoring import WIDTH_CLASSES
from flockd.ground.pictures.single_frame import Box

Image = NDArray[np.uint8]
Picture = tuple[str, Callable[[], Image], tuple[Box, ...]]
"""Its name, what reads it (RGB), and the drones in it."""

PROBABILITIES = (0.0, 0.9, 0.95, 0.98, 0.99)
"""What is counted when only detections at least so probable count; 0: all that the pipeline reports."""


def main() -> None:
    """Run the pipeline over every set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labelled", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--without-drones", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--models", type=Path, default=data_path("models"), help="folder of the networks")
    parser.add_argument("--distance", default="distance_int8")
    parser.add_argument("--verification", default="verification_int8")
    parser.add_argument("--neighbours", default="neighbours_int8")
    parser.add_argument("--detector", default=PerceptionConfig().detector)
    parser.add_argument("--fov", type=float, default=90.0, metavar="DEG", help="across the longer side")
    parser.add_argument("--scale", type=float, default=1.0, help="resize every picture first")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--detections", type=Path, help="write every detection of every picture as JSON")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    sets: dict[str, list[Picture]] = {}
    for given in arguments.labelled:
        name, _, folder = given.partition("=")
        sets[name] = list(labelled_pictures(Path(folder)))
    for given in arguments.without_drones:
        name, _, folder = given.partition("=")
        sets[name] = list(free_pictures(Path(folder)))
    if not sets:
        parser.error("give --labelled or --without-drones")
    config = PerceptionConfig(
        depth=arguments.neighbours, segmentation=arguments.neighbours, distance=arguments.distance,
        verification=arguments.verification, detector=arguments.detector, models_dir=str(arguments.models),
        threads=arguments.threads,
    )  # fmt: skip
    detector = PictureDetector(config)
    results: dict[str, dict[str, Any]] = {}
    written: dict[str, list[dict[str, object]]] = {}
    for name, pictures in sets.items():
        shown = track(pictures, name, console=Console(stderr=True), disable=not sys.stderr.isatty())
        results[name], measured = _measured(detector, shown, arguments.fov, arguments.scale)
        written[name] = [
            {"picture": picture, "boxes": one.boxes, "found": [asdict(drone) for drone in one.detections]}
            for (picture, _, _), one in zip(pictures, measured, strict=True)
        ]
    if arguments.detections:
        arguments.detections.write_text(json.dumps(written), encoding="utf-8")
    if arguments.json:
        print(json.dumps(results, indent=1))
    else:
        _print_table(results)


def _measured(
    detector: PictureDetector, pictures: Iterable[Picture], fov_deg: float, scale: float
) -> tuple[dict[str, Any], list[Labelled]]:
    """One set's figures, and what was found in each picture."""
    begin = time.monotonic()
    measured, proposals = list[Labelled](), 0
    for _, read, boxes in pictures:
        image = read()
        if scale != 1.0:
            image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        resized = tuple((scale * a, scale * b, scale * c, scale * d) for a, b, c, d in boxes)
        found = detector.detect(image, fov_deg=fov_deg)
        measured.append(Labelled(found.detections, resized))
        proposals += found.proposals
    ms = 1e3 * (time.monotonic() - begin) / max(len(measured), 1)
    figures = {
        "images": len(measured),
        **summary(measured),
        "proposals_per_image": round(proposals / max(len(measured), 1), 2),
        "ms_per_image": round(ms, 1),
        "at_probability": {str(p): summary(measured, p) for p in PROBABILITIES[1:]},
    }
    return figures, measured


def labelled_pictures(folder: Path) -> Iterator[Picture]:
    """The pictures that a folder's ``labels.json`` names."""
    for picture, labels in read_labels(folder / "labels.json", find_pictures([folder])).items():
        yield str(picture.relative), partial(_image, picture), labels.boxes


def free_pictures(folder: Path) -> Iterator[Picture]:
    """Every picture in a folder and those below it, in which no drone is."""
    for picture in find_pictures([folder]):
        if not picture.is_video:
            yield str(picture.relative), partial(_image, picture), ()


def _image(picture: PictureFile) -> Image:
    (_, image) = next(picture.images(1))
    return image


def _print_table(results: dict[str, dict[str, Any]]) -> None:
    table = Table("set", "images", *(f"{w} px" for w in WIDTH_CLASSES), "AP50", "false, pictures", "proposals", "ms")
    for name, all_of in results.items():
        rows = {"": all_of, **{f" p >= {p}": one for p, one in all_of["at_probability"].items()}}
        for note, one in rows.items():
            cells = [
                f"{100 * c['found'] / c['boxes']:.0f} % of {c['boxes']}" if (c := one["by_width"][w])["boxes"] else ""
                for w in WIDTH_CLASSES
            ]
            table.add_row(
                name + note, str(all_of["images"]), *cells, "" if one["ap50"] is None else f"{one['ap50']:.3f}",
                f"{one['false']} in {one['measured']}", str(all_of["proposals_per_image"]), str(all_of["ms_per_image"]),
            )  # fmt: skip
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
