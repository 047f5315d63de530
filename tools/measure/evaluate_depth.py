"""Measure depth networks on real scenes whose depth is known up to a scale: a table of each.

    python -m tools.training.moving_cameras VIDEO --out CLIPS/name.npz
    python -m tools.measure.evaluate_depth CLIPS models/neighbours.yaml MINE/neighbours.yaml
    python -m tools.measure.evaluate_depth --rgbd FOLDER models/neighbours.yaml

FOLDER has a depth camera's pictures: images/*, depth/* of the same names (16 bits, millimetres, 0 unknown) and K.txt.
Networks see each picture at 288 px along the shorter side and are told the lens: without attitude and height, where
only how depths relate can be judged, and, where flat ground is seen, 2 m above it, where the metres can be of what
stands on it. Beside them is what any has to beat: one depth everywhere, and told the height, the ground's.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel
from tools.training.moving_cameras import Clip, ground_of
from tools.training.networks import MAX_DEPTH_M

DepthOf = Callable[[NDArray[np.uint8], NDArray[np.float32]], NDArray[np.float32]]
"""Image (h, w, 3), planes (3, h/2, w/2) -> depth (h/2, w/2), as the input and the output of `neighbours`."""

SHORT_SIDE_PX = 288
HEIGHT_M = 2.0
_STANDS = 0.8
"""Of the ground's depth behind it: what is nearer stands on the ground."""
_MIN_PIXELS = 200
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
    networks = {"the ground everywhere, or one depth": _ground} | {
        str(one): _network(one) for one in arguments.manifests
    }
    print("| scene | network | off by, median | nearest quarter | farthest quarter | told the height: what stands |")
    print("|---|---|---|---|---|---|")
    for name, clip in scenes.items():
        for network, depth_of in networks.items():
            row = measured(depth_of, clip)
            told = "-" if np.isnan(row.off_told_height) else f"{row.off_told_height:.0%}"
            print(f"| {name} | {network} | {row.off:.0%} | {row.near:+.0%} | {row.far:+.0%} | {told} |")
    print("\nNearest and farthest quarter of each picture's known pixels: by how much too far they are said to be.")


def rgbd(folder: Path) -> Clip:
    """What a depth camera saw."""
    files = sorted((folder / "images").iterdir())
    images = [np.asarray(cv2.imread(str(file)))[:, :, ::-1] for file in files]
    depth = [np.asarray(cv2.imread(str(folder / "depth" / file.name), cv2.IMREAD_UNCHANGED)) for file in files]
    metres = np.stack(depth).astype(np.float32) / 1000.0
    metres[metres == 0] = np.nan
    return Clip(np.stack(images).astype(np.uint8), metres.astype(np.float16), float(np.loadtxt(folder / "K.txt")[0, 0]))


def _network(manifest: Path) -> DepthOf:
    model = OnnxModel(manifest, threads=2)
    return lambda image, planes: model.run({"image": image[None], "geometry": planes[None]})["depth"][0, 0]


def _ground(_: NDArray[np.uint8], planes: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(1.0 / np.maximum(planes[2], 1.0 / MAX_DEPTH_M), np.float32)


@dataclass(frozen=True)
class Row:
    """Medians over the pictures of one scene: relative errors."""

    off: float
    """Of a pixel, up to each picture's own scale."""
    near: float
    """Of the nearest quarter of what is known, likewise; above 0: too far."""
    far: float
    off_told_height: float
    """Of a pixel of what stands on flat ground, in metres; NaN where no picture shows such."""


def measured(depth_of: DepthOf, clip: Clip) -> Row:
    """What a network says of some pictures of a scene."""
    chosen = np.unique(np.linspace(0, len(clip.images) - 1, PICTURES).astype(int))
    rows = [_measured(depth_of, *_seen(clip, k), ground_of(clip.depth[k], clip.focal_px)) for k in chosen]
    off, near, far, told = zip(*rows, strict=True)
    known = [one for one in told if one is not None]
    return Row(float(np.median(off)), float(np.median(near)), float(np.median(far)), float(np.median(known or np.nan)))


def _seen(clip: Clip, k: int) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]:
    """A picture (h, w, 3) as networks see it, its depth (h/2, w/2), and the tangents of its rays (3, h/2, w/2)."""
    image = clip.images[k]
    scale = SHORT_SIDE_PX / min(image.shape[:2])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    width, height = (side // 32 * 32 for side in size)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    window = np.s_[top : top + height, left : left + width]
    seen = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)[window], np.uint8)
    depth = cv2.resize(clip.depth[k].astype(float), size, interpolation=cv2.INTER_NEAREST)[window][::2, ::2]
    right, down = ((np.arange(1, side, 2) - side / 2) / (clip.focal_px * scale) for side in (width, height))
    tangents = np.broadcast_arrays(right[None, :], down[:, None], np.ones_like(depth))
    return seen, np.asarray(depth, float), np.stack(tangents)


def _measured(
    depth_of: DepthOf,
    image: NDArray[np.uint8],
    depth: NDArray[np.float64],
    tangents: NDArray[np.float64],
    ground: NDArray[np.float64] | None,
) -> tuple[float, float, float, float | None]:
    """Off, near and far as in `Row`; off when told the height, None without ground."""

    def apart(inverse_ground: NDArray[np.float64], metres: float) -> NDArray[np.float64]:
        planes = np.stack([*tangents[:2], inverse_ground]).astype(np.float32)
        return np.asarray(np.log(depth_of(image, planes)[known]) - np.log(depth[known] * metres), float)

    known = np.isfinite(depth)
    off = apart(np.zeros_like(depth), 1.0)
    off -= np.median(off)
    away = depth[known]
    ends = away <= np.quantile(away, 0.25), away >= np.quantile(away, 0.75)
    near, far = (float(np.expm1(np.median(off[end]))) for end in ends)
    told = None
    if ground is not None:
        metres = HEIGHT_M * float(np.linalg.norm(ground))
        of_ground = np.maximum(np.tensordot(ground, tangents, 1), 0.0) / metres
        stands = away * metres * of_ground[known] < _STANDS
        if stands.sum() >= _MIN_PIXELS:
            told = float(np.median(np.abs(np.expm1(apart(of_ground, metres)[stands]))))
    return float(np.median(np.abs(np.expm1(off)))), near, far, told


if __name__ == "__main__":
    main()
