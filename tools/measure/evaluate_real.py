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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.ground.pictures.picture_files import PictureFile, find_pictures, read_labels
from flockd.ground.pictures.scoring import WIDTH_CLASSES, Labelled, summary
from flockd.ground.pictures.single_frame import Box, PictureDetector

Image = NDArray[np.uint8]
Picture = tuple[str, Callable[[], Image], tuple[Box, ...]]
"""Its name, what reads it (RGB), and the drones in it."""


def main() -> None:
    """Run the pipeline over every set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labelled", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--without-drones", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--models", type=Path, default=data_path("models"), help="folder of the networks")
    parser.add_argument("--detector", default=PerceptionConfig().detector, help="its name, or none")
    parser.add_argument("--fov", type=float, default=90.0, metavar="DEG", help="across the longer side")
    parser.add_argument("--threads", type=int, default=1)
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
    models = {"models_dir": str(arguments.models), "detector": arguments.detector, "threads": arguments.threads}
    detector = PictureDetector(PerceptionConfig.model_validate(models))
    results: dict[str, dict[str, Any]] = {}
    for name, pictures in sets.items():
        shown = track(pictures, name, console=Console(stderr=True), disable=not sys.stderr.isatty())
        results[name] = _measured(detector, shown, arguments.fov)
    if arguments.json:
        print(json.dumps(results, indent=1))
    else:
        _print_table(results)


def _measured(detector: PictureDetector, pictures: Iterable[Picture], fov_deg: float) -> dict[str, Any]:
    """One set's figures."""
    begin = time.monotonic()
    measured, proposals = list[Labelled](), 0
    for _, read, boxes in pictures:
        found = detector.detect(read(), fov_deg=fov_deg)
        measured.append(Labelled(found.detections, boxes))
        proposals += found.proposals
    count = max(len(measured), 1)
    return {
        "images": len(measured),
        **summary(measured),
        "proposals_per_image": round(proposals / count, 2),
        "ms_per_image": round(1e3 * (time.monotonic() - begin) / count, 1),
    }


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
    for name, one in results.items():
        cells = [
            f"{100 * c['found'] / c['boxes']:.0f} % of {c['boxes']}" if (c := one["by_width"][w])["boxes"] else ""
            for w in WIDTH_CLASSES
        ]
        table.add_row(
            name, str(one["images"]), *cells, "" if one["ap50"] is None else f"{one['ap50']:.3f}",
            f"{one['false']} in {one['measured']}", str(one["proposals_per_image"]), str(one["ms_per_image"]),
        )  # fmt: skip
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
