"""Measure distance networks on crops of unseen drones, and print one table.

    python -m tools.training.render_drone_crops CROPS --held-out --worlds 8    # --mesh for a drone of your own
    python -m tools.measure.evaluate_crops CROPS models/distance_int8.yaml MINE/distance_int8.yaml

Counted are whole drones in the middle of a crop that they fill, as the cascade's last crop shows them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel
from tools.training.pictures import is_aimed

Array = NDArray[Any]
RANGES_M = ((1.5, 5.0), (5.0, 10.0))
_BATCH = 64


def held_out(folder: Path) -> tuple[dict[str, Array], Array]:
    """Crops of ``render_drone_crops --held-out``: arrays (n, ...) of whole drones aimed at as the cascade's last crop
    is; pictures (m, 96, 96, 3) without a drone. Raises ValueError where the files are not such.
    """
    rows: list[dict[str, Array]] = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as arrays:
            rows.append(dict(arrays))
    if not rows or "whole" not in rows[0]:
        raise ValueError(f"{folder}: holds no crops with ranges; make them with `render_drone_crops --held-out`")
    joined = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    shown = joined["whole"] & is_aimed(joined)
    return {name: values[shown] for name, values in joined.items()}, joined["picture"][joined["drone"] < 0.5]


def measured(manifest: Path, crops: dict[str, Array], none: Array) -> dict[str, str]:
    """A network's figures by name; relative errors of range are of one crop, without the cascade's mean."""
    model = OnnxModel(manifest, threads=1)
    out, no = _columns(model, crops["picture"]), _columns(model, none)
    log_range, range_m = crops["target"][:, 0], crops["range_m"]
    error = np.expm1(out["log_range_per_focal"] - log_range)
    by_size = np.expm1(crops["apparent"] - out["log_apparent_size"])
    figures: dict[str, str] = {}
    for name, errors in (("range", error), ("range by the known size", by_size)):
        for low, high in RANGES_M:
            at = (low <= range_m) & (range_m < high)
            if at.any():
                off = np.abs(errors[at])
                figures[f"error of {name}, {low:g}-{high:g} m, median / p95 / bias"] = (
                    f"{np.median(off):.2%} / {np.quantile(off, 0.95):.2%} / {np.median(errors[at]):+.2%}"
                )
    of_size = np.exp(out["log_size_sigma"]) if "log_size_sigma" in out else 0.0
    sigmas = np.abs(out["log_range_per_focal"] - log_range) / np.hypot(np.exp(out["log_relative_sigma"]), of_size)
    figures["errors inside 1 and 2 sigma"] = f"{np.mean(sigmas < 1):.0%}, {np.mean(sigmas < 2):.0%}"
    least = np.log(1 / (1 / model.manifest.thresholds["drone_probability"] - 1))
    figures["drones called a drone"] = f"{np.mean(out['drone_logit'] > least):.1%}"
    figures["crops without a drone called one"] = f"{np.mean(no['drone_logit'] > least):.1%}"
    return figures


def _columns(model: OnnxModel, pictures: Array) -> dict[str, Array]:
    (name,) = model.manifest.inputs
    spec = model.manifest.results["range"]
    parts = [
        spec.by_column(model.run({name: pictures[k : k + _BATCH]})["range"]) for k in range(0, len(pictures), _BATCH)
    ]
    return {column: np.concatenate([part[column] for part in parts]).astype(float) for column in spec.columns}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("crops", type=Path, help="folder of tools.training.render_drone_crops --held-out")
    parser.add_argument("manifests", type=Path, nargs="+", help="of distance networks")
    arguments = parser.parse_args()
    try:
        crops, none = held_out(arguments.crops)
    except ValueError as error:
        parser.error(str(error))
    print(f"{len(crops['picture'])} crops with a drone, {len(none)} without")
    figures = [measured(manifest, crops, none) for manifest in arguments.manifests]
    print(" " * 56, *arguments.manifests, sep="  ")
    for name in figures[0]:
        print(f"{name:56}", *(f"{one[name]:24}" for one in figures), sep="  ")


if __name__ == "__main__":
    main()
