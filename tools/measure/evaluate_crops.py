"""Measure distance networks on crops of drones that none of them has learnt from: a table of each drone.

    python -m tools.training.render_drone_crops CROPS --airframes AIRFRAMES --held-out --worlds 8
    python -m tools.measure.evaluate_crops CROPS models/distance_int8.yaml MINE/distance_int8.yaml

Counted are whole drones in the middle of a crop that they fill, as the cascade's last crop shows them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tools.measure.evaluation.on_crops import HeldOut, measured
from tools.training.airframes import name_of
from tools.training.specialising.runs import table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("crops", type=Path, help="folder of tools.training.render_drone_crops --held-out")
    parser.add_argument("manifests", type=Path, nargs="+", help="of distance networks")
    arguments = parser.parse_args()
    try:
        crops = HeldOut.of(arguments.crops)
    except ValueError as error:
        parser.error(str(error))
    of_each = {name_of(int(family)): crops.of_family(family) for family in np.unique(crops.family)}
    for name, its in ({"all drones": crops} | of_each).items():
        print(f"{name}, {len(its.picture)} crops")
        print(table({str(manifest): measured(manifest, its) for manifest in arguments.manifests}), end="\n\n")


if __name__ == "__main__":
    main()
