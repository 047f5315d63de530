"""Measure distance networks on crops of drones, and print one table a network: drone by drone.

    python -m tools.training.render_drone_crops CROPS --airframes AIRFRAMES --held-out --worlds 8
    python -m tools.measure.evaluate_crops CROPS models/distance_int8.yaml MINE/distance_int8.yaml

Counted are drones in the middle of a crop that they fill, as the cascade's last crop shows them; of crops with ranges
(--held-out) those alone that are whole and 1.5 to 5 m away.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from flockd.flight.inference import OnnxModel
from tools.training.airframes import name_of
from tools.training.crop_files import is_aimed

Array = NDArray[Any]
_AT_ONCE = 64
_MOST_SIZE_SIGMA = 0.5
"""Beyond which flockd holds a size for unknown."""
_NEAR_M, _FAR_M = 1.5, 5.0


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("crops", type=Path, help="folder of tools.training.render_drone_crops")
    parser.add_argument("manifests", type=Path, nargs="+", help="of distance networks")
    arguments = parser.parse_args()
    files = [dict(np.load(file)) for file in sorted(arguments.crops.glob("*.npz"))]
    if not files:
        parser.error(f"{arguments.crops}: no crops here; make them with `python -m tools.training.render_drone_crops`")
    crops = {name: np.concatenate([file[name] for file in files]) for name in files[0]}
    for manifest in arguments.manifests:
        table = Table("drone", "crops", "range: median", "95 %", "bias", "apparent size", "in 1, 2 sigma", "a drone")
        for row in rows(OnnxModel(manifest, threads=2), crops):
            table.add_row(*row)
        print(manifest)
        Console(width=120).print(table)


def rows(model: OnnxModel, crops: dict[str, Array]) -> Iterator[tuple[str, ...]]:
    """Of all drones, of each by its name, and last what share of the crops without one is called a drone."""
    pictures = crops["picture"]
    parts = [pictures[k : k + _AT_ONCE] for k in range(0, len(pictures), _AT_ONCE)]
    out = np.concatenate([model.run({"picture": part})["range"] for part in parts])
    log_error, apparent = out[:, 0] - crops["target"][:, 0], np.expm1(out[:, 5] - crops["apparent"])
    sigma = np.hypot(np.exp(out[:, 3]), np.minimum(np.exp(out[:, 6]), _MOST_SIZE_SIGMA))
    there = crops["drone"] > 0.5
    counted = there & is_aimed(crops)
    if "whole" in crops:
        counted &= crops["whole"] & (crops["range_m"] > _NEAR_M) & (crops["range_m"] < _FAR_M)
    families = np.unique(crops["family"][counted])
    named = {name_of(int(family)): counted & (crops["family"] == family) for family in families}
    for name, which in ({"all": counted} | named).items():
        error, within = np.expm1(log_error[which]), np.abs(log_error[which]) / sigma[which]
        yield (
            name, str(which.sum()), _percent(np.median(np.abs(error))), _percent(np.percentile(np.abs(error), 95)),
            f"{100 * np.median(error):+.1f} %", _percent(np.median(np.abs(apparent[which]))),
            f"{_percent((within < 1).mean(), 0)}, {_percent((within < 2).mean(), 0)}",
            _percent((out[which, 4] > 0).mean(), 0),
        )  # fmt: skip
    if not there.all():
        yield ("none", str((~there).sum()), "", "", "", "", "", _percent((out[~there, 4] > 0).mean()))


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f} %"


if __name__ == "__main__":
    main()
