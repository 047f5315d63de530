"""Find what the segmentation network wrongly takes for drones: the distance network learns to say no to it.

python -m tools.training.mine_negatives --data DATA/training --model RUNS/models/neighbours.yaml --out
DATA/negatives.npy
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel
from flockd.flight.perception import group_instances
from flockd.flight.perception.requirements import check_roles
from tools.training.dataset import PairSet, ground_plane, open_pairs, ray_tangents


def main() -> None:
    """Write (n, 5): pair, image, centre right and down in px, half of the box's longer side in px."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True, help="manifest of a neighbours network")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    pairs = open_pairs(arguments.data)
    found = mined(pairs, OnnxModel(arguments.model, threads=arguments.threads, check=check_roles))
    np.save(arguments.out, found)
    print(f"{arguments.out}: {len(found)} in {pairs.count} images")


def mined(pairs: PairSet, model: OnnxModel) -> NDArray[np.float32]:
    """(n, 5) as ``main`` writes them, of the pairs' first images."""
    found = []
    for pair in range(pairs.count):
        focal = float(pairs["focal"][pair])
        ground = ground_plane(focal, pairs["R_ned_camera"][pair, 0], float(pairs["height"][pair, 0]))
        planes = np.concatenate([ray_tangents(focal), ground[None]])
        out = model.run({"image": np.asarray(pairs["image"][pair][0])[None], "geometry": planes[None]})
        ids = np.asarray(pairs["ids"][pair][0])
        logit = out["drone"][0, 0] - np.float32(model.manifest.threshold("proposal_logit"))
        labels, instances = group_instances(logit, out["offset"][0], scale=model.manifest.map_stride or 1)
        for instance in instances:
            if (ids[labels == instance.label] > 0).mean() < 0.05:
                left, top, right, bottom = instance.box
                half = max(right - left, bottom - top) / 2
                found.append((pair, 0, (left + right) / 2, (top + bottom) / 2, half))
    return np.array(found, np.float32).reshape(-1, 5)


if __name__ == "__main__":
    main()
