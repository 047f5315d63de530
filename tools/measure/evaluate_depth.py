"""Measure depth networks on real scenes whose depth is known up to a scale: a table of each.

    python -m tools.training.moving_cameras VIDEO --out CLIPS/name.npz
    python -m tools.measure.evaluate_depth CLIPS models/neighbours.yaml MINE/neighbours.yaml
    python -m tools.measure.evaluate_depth --rgbd FOLDER models/neighbours.yaml

FOLDER has a depth camera's pictures: images/*, depth/* of the same names (16 bits, millimetres, 0 unknown) and K.txt.
Networks see each picture at 288 px along the shorter side, without attitude and height, and are told the lens.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel
from tools.training.moving_cameras import Clip

SHORT_SIDE_PX = 288
PICTURES = 20
"""Of a clip, spread over it."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="?", help="folder of tools.training.moving_cameras")
    parser.add_argument("manifests", type=Path, nargs="+", help="of networks with depth")
    parser.add_argument("--rgbd", type=Path, metavar="FOLDER", help="pictures of a depth camera, instead of clips")
    arguments = parser.parse_args()
    if arguments.rgbd:
        scenes = {arguments.rgbd.name: rgbd(arguments.rgbd)}
        arguments.manifests = [path for path in (arguments.clips, *arguments.manifests) if path]
    else:
        scenes = {file.stem: Clip.load(file) for file in sorted(arguments.clips.glob("*.npz"))}
    if not scenes:
        parser.error(f"{arguments.clips}: no clips; make them with `python -m tools.training.moving_cameras`")
    print("| scene | network | off by, median | correlation of log depth | nearest quarter | farthest quarter |")
    print("|---|---|---|---|---|---|")
    for name, clip in scenes.items():
        for manifest in arguments.manifests:
            off, alike, near, far = measured(OnnxModel(manifest, threads=2), clip)
            print(f"| {name} | {manifest} | {off:.0%} | {alike:.2f} | {near:+.0%} | {far:+.0%} |")
    print(
        "\nEach picture's depth has its own scale. Nearest and farthest: how much too far those pixels are said to be."
    )


def rgbd(folder: Path) -> Clip:
    """What a depth camera saw."""
    files = sorted((folder / "images").iterdir())
    images = [np.asarray(cv2.imread(str(file)))[:, :, ::-1] for file in files]
    depth = [np.asarray(cv2.imread(str(folder / "depth" / file.name), cv2.IMREAD_UNCHANGED)) for file in files]
    metres = np.stack(depth).astype(np.float32) / 1000.0
    metres[metres == 0] = np.nan
    return Clip(np.stack(images).astype(np.uint8), metres.astype(np.float16), float(np.loadtxt(folder / "K.txt")[0, 0]))


def measured(model: OnnxModel, clip: Clip) -> tuple[float, float, float, float]:
    """Medians over the pictures of what the table's columns say."""
    chosen = np.unique(np.linspace(0, len(clip.images) - 1, PICTURES).astype(int))
    rows = [_measured(model, clip.images[k], clip.depth[k].astype(float), clip.focal_px) for k in chosen]
    off, alike, near, far = np.median(rows, axis=0)
    return float(off), float(alike), float(near), float(far)


def _measured(
    model: OnnxModel, image: NDArray[np.uint8], depth: NDArray[np.float64], focal: float
) -> tuple[float, float, float, float]:
    scale = SHORT_SIDE_PX / min(image.shape[:2])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    width, height = (side // 32 * 32 for side in size)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    window = np.s_[top : top + height, left : left + width]
    seen = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)[window], np.uint8)
    true = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)[window][::2, ::2]
    right, down = ((np.arange(1, side, 2) - side / 2) / (focal * scale) for side in (width, height))
    planes = np.stack([*np.broadcast_arrays(right[None, :], down[:, None]), np.zeros_like(true)]).astype(np.float32)
    said = model.run({"image": seen[None], "geometry": planes[None]})["depth"][0, 0]
    known = np.isfinite(true)
    away = np.log(true[known])
    apart = np.log(said[known].astype(float)) - away
    apart -= np.median(apart)
    nearest, farthest = away <= np.quantile(away, 0.25), away >= np.quantile(away, 0.75)
    alike = float(np.corrcoef(apart + away, away)[0, 1])
    near, far = (float(np.expm1(np.median(apart[part]))) for part in (nearest, farthest))
    return float(np.median(np.abs(np.expm1(apart)))), alike, near, far


if __name__ == "__main__":
    main()
