"""Depth of real scenes, from videos of a camera that moves among what stands still.

    python -m tools.training.moving_cameras VIDEO --focal 0.8 --every 2 --out CLIPS/name.npz

Of each picture and four others close to it in time: dense flow, where it leads back to where it began; the motion
between them (essential matrix); triangulation of what obeys it. What at least two agree on is the picture's depth, up
to one scale. ``--focal`` is the focal length in lengths of the picture's longer side; ``--focal find`` tries several
and takes the one that most matches obey, which scenes that are no plane tell well. Look at the picture beside the file.

`tools.training.train neighbours --moving CLIPS` learns from the files; see docs/networks.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.geometry import PinholeCamera, RigidTransform, grid_pixels, inverse_ranges_of_rays
from tools.training.augment import as_filmed
from tools.training.networks import MAX_DEPTH_M

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

LONG_SIDE_PX = 640
FOCALS = (0.38, 0.44, 0.5, 0.55, 0.6, 0.65, 0.75, 0.82, 0.9)
"""Focal lengths to try, in lengths of the longer side: 106 to 58 degrees of view along it."""
OTHERS = (-2, -1, 1, 2)
"""Pictures before and after that are looked at with each."""
_EPIPOLAR_PX = 1.0
_FLOW_SIGMA_PX = 0.7
_CERTAIN_SIGMAS = 6.0
_MIN_INLIERS = 0.75
"""Of the matches that one motion explains: with less, something moves, or the focal length is wrong."""
_MIN_KNOWN = 0.15
_HEIGHTS_M = (1.0, 10.0)
"""Between which a sample's height above ground is drawn."""
_GROUND_SHARE, _GROUND_UNDER = 0.25, 0.03
"""Of what is known of a picture: the least that lies on its ground, and the most that may lie under it."""
_GROUND_ROLL, _GROUND_DOWN = 0.3, 0.1
"""Sines of the most by which ground may fall to the side, and of the least by which it faces upwards in the picture:
what faces the camera may be a wall."""
_AGREED = 0.2
"""Between the nearest and the farthest that one pixel's depths are, in natural logarithms."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Pictures of one scene with depth along the optical axis."""

    images: Image
    """(n, h, w, 3) RGB"""
    depth: NDArray[np.float16]
    """(n, h, w), in a unit of each picture's own; NaN where unknown."""
    focal_px: float

    def save(self, file: Path) -> None:
        """As an archive that `load` reads."""
        np.savez_compressed(file, image=self.images, depth=self.depth, focal=self.focal_px)

    @classmethod
    def load(cls, file: Path) -> Clip:
        """What `save` wrote."""
        with np.load(file) as arrays:
            return cls(arrays["image"], arrays["depth"], float(arrays["focal"]))


class MovingCameras:
    """Samples for `NeighboursNet` of real scenes whose depth is known up to a scale, without drones.

    Where flat ground is seen, some are told the height above it, of any metres: then the depth has its metres too.
    """

    with_height = 0.6

    def __init__(self, folder: Path) -> None:
        self._clips = [Clip.load(file) for file in sorted(folder.glob("*.npz"))]
        if not self._clips:
            raise FileNotFoundError(f"{folder}: no clips; make them with `python -m tools.training.moving_cameras`")
        self._grounds = [[ground_of(depth, clip.focal_px) for depth in clip.depth] for clip in self._clips]

    def sample(self, rng: np.random.Generator, crop_px: int) -> dict[str, NDArray[Any]]:
        """A square window of some picture, all clips as often, as `tools.training.samples.neighbours_sample` gives it.

        Depth is NaN where it is unknown.
        """
        of = int(rng.integers(len(self._clips)))
        clip = self._clips[of]
        k = int(rng.integers(len(clip.images)))
        image, depth = clip.images[k], clip.depth[k].astype(np.float32)
        height, width = depth.shape
        scale = float(np.exp(rng.uniform(np.log(crop_px / min(height, width)), np.log(1.3))))
        size = (max(crop_px, round(width * scale)), max(crop_px, round(height * scale)))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        image = np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)
        depth = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
        left, top = (int(rng.integers(side - crop_px + 1)) for side in size)
        window = np.s_[top : top + crop_px, left : left + crop_px]
        middles = np.arange(1, crop_px, 2)
        focal = clip.focal_px * scale
        right = (left + middles - size[0] / 2) / focal
        down = (top + middles - size[1] / 2) / focal
        planes = np.stack([*np.broadcast_arrays(right[None, :], down[:, None]), np.ones((crop_px // 2, crop_px // 2))])
        ground, metric = self._grounds[of][k], 0.0
        inverse_ground = np.zeros_like(planes[0])
        if ground is not None and rng.random() < self.with_height:
            metres = np.exp(rng.uniform(*np.log(_HEIGHTS_M))) * np.linalg.norm(ground)
            metric, depth = 1.0, np.minimum(depth * np.float32(metres), np.float32(MAX_DEPTH_M))
            ground = (ground + rng.normal(0, 0.005, 3) * np.linalg.norm(ground)) * (1 + rng.normal(0, 0.02))
            inverse_ground = np.maximum(np.tensordot(ground, planes, 1), 0.0) / metres
        geometry = np.stack([*planes[:2], inverse_ground]).astype(np.float32)
        image, depth = as_filmed(np.ascontiguousarray(image[window]), rng), depth[window][::2, ::2]
        if rng.random() < 0.5:
            image, depth, geometry = image[:, ::-1], depth[:, ::-1], geometry[:, :, ::-1].copy()
            geometry[0] *= -1
        nothing = np.zeros((1, crop_px // 2, crop_px // 2), np.float32)
        return {
            "image": np.ascontiguousarray(image),
            "geometry": geometry,
            "depth": np.ascontiguousarray(depth)[None],
            "drone": nothing,
            "offset": np.repeat(nothing, 2, axis=0),
            "metric": np.array(metric, np.float32),
        }


def ground_of(depth: NDArray[Any], focal_px: float) -> NDArray[np.float64] | None:
    """(3,) n of the flat ground n . P = 1 under a camera, in its axes and the depth's unit; None where none is seen.

    A plane's inverse depth is linear in the rays' tangents. Much lies on the ground, and hardly anything under it.
    """
    height, width = depth.shape
    row, column = np.nonzero(np.isfinite(depth))
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(row), min(len(row), 2000), replace=False)
    row, column = row[chosen], column[chosen]
    inverse = 1.0 / depth[row, column].astype(float)
    tangents = [(column + 0.5 - width / 2) / focal_px, (row + 0.5 - height / 2) / focal_px, np.ones(len(row))]
    rays = np.stack(tangents, axis=1)
    best, most = None, _GROUND_SHARE
    for _ in range(150):
        three = rng.choice(len(row), 3, replace=False)
        if abs(np.linalg.det(rays[three])) < 1e-6:
            continue
        normal = np.linalg.solve(rays[three], inverse[three])
        right, down = normal[:2] / np.linalg.norm(normal)
        if down < _GROUND_DOWN or abs(right) > _GROUND_ROLL:
            continue
        off = inverse / np.maximum(rays @ normal, 1e-9) - 1.0
        on = float((np.abs(off) < 0.05).mean())
        if on > most and (off < -0.1).mean() < _GROUND_UNDER:
            best, most = normal, on
    return best


def clip_of(pictures: Sequence[Image], focal: float | None) -> Clip:
    """Pictures (h, w, 3) RGB of a video in turn, with the depth of those of which enough is known.

    ``focal``: in lengths of the longer side; None: found. Raises ValueError where of no picture enough is known.
    """
    motions = _Motions(pictures)
    if focal is None:
        focal = max(FOCALS, key=motions.share_obeying)
    images, maps = [], []
    for index, image in enumerate(pictures):
        depth = motions.depth(index, focal)
        if depth is not None:
            images.append(image)
            maps.append(depth)
    if not maps:
        raise ValueError("of no picture's depth enough is known: the camera stood still, or what it saw moved")
    return Clip(np.stack(images), np.stack(maps).astype(np.float16), focal * max(pictures[0].shape[:2]))


class _Motions:
    """Flow between the pictures of a video, and what follows from it."""

    def __init__(self, pictures: Sequence[Image]) -> None:
        self._grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
        self._flows: dict[tuple[int, int], Map] = {}
        self._dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._dense.setFinestScale(0)
        self._rng = np.random.default_rng(0)

    def share_obeying(self, focal: float) -> float:
        """Share of all matches of some neighbouring pictures that one motion explains."""
        pairs = [(k, k + 1) for k in range(0, len(self._grey) - 1, max(1, len(self._grey) // 12))]
        return float(np.mean([0.0 if (found := self._motion(a, b, focal)) is None else found[1] for a, b in pairs]))

    def depth(self, index: int, focal: float) -> Map | None:
        """(h, w) depth, its median 1, NaN where unknown; None where too little is known."""
        logs: list[Map] = []
        for other in (index + step for step in OTHERS if 0 <= index + step < len(self._grey)):
            found = self._motion(index, other, focal)
            if found is None or found[1] < _MIN_INLIERS:
                continue
            log = np.log(self._triangulated(index, other, focal, found[0]))
            both = np.isfinite(log) & np.isfinite(logs[0]) if logs else np.isfinite(log)
            if np.isfinite(log).mean() >= _MIN_KNOWN and both.mean() >= 0.01:
                logs.append(log + np.float32(np.median((logs[0] - log)[both])) if logs else log)
        if len(logs) < 2:
            return None
        every = np.sort(np.stack(logs), axis=0)  # NaN last
        count = np.isfinite(every).sum(0)
        last = np.take_along_axis(every, np.maximum(count - 1, 0)[None], 0)[0]
        middle = np.take_along_axis(every, (np.maximum(count - 1, 0) // 2)[None], 0)[0]
        agreed = (count >= 2) & (last - every[0] < _AGREED)
        if agreed.mean() < _MIN_KNOWN:
            return None
        depth: Map = np.where(agreed, np.exp(middle - np.median(middle[agreed])), np.nan).astype(np.float32)
        return depth

    def _flow(self, a: int, b: int) -> Map:
        if (a, b) not in self._flows:
            for pair in [pair for pair in self._flows if min(pair) < min(a, b) - 2 * max(OTHERS)]:
                del self._flows[pair]
            self._flows[a, b] = np.asarray(
                self._dense.calc(self._grey[a], self._grey[b], np.zeros((0, 0), np.float32)), np.float32
            )
        return self._flows[a, b]

    def _returning(self, a: int, b: int) -> NDArray[np.bool_]:
        """(h, w) of the pixels of ``a``: whether the flow to ``b`` and back ends where it began."""
        there, back = self._flow(a, b), self._flow(b, a)
        row, column = np.mgrid[: there.shape[0], : there.shape[1]].astype(np.float32)
        outside = (1e3, 1e3)
        returned = cv2.remap(
            back, column + there[..., 0], row + there[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, outside
        )
        off, moved = there + returned, np.hypot(there[..., 0], there[..., 1])
        return np.asarray(np.hypot(off[..., 0], off[..., 1]) < 0.5 + 0.03 * moved)

    def _motion(self, a: int, b: int, focal: float) -> tuple[RigidTransform, float] | None:
        """From ``a``'s camera axes to ``b``'s with a way of length 1, and the share of matches that obey it."""
        flow, returning = self._flow(a, b), self._returning(a, b)
        row, column = np.nonzero(returning)
        if len(row) < 3000:
            return None
        chosen = self._rng.choice(len(row), 3000, replace=False)
        row, column = row[chosen], column[chosen]
        start = np.stack([column, row], axis=1) + 0.5
        end = start + flow[row, column]
        matrix = self._camera(focal).matrix
        essential, obeying = cv2.findEssentialMat(start, end, matrix, cv2.USAC_MAGSAC, 0.9999, _FLOW_SIGMA_PX)
        if essential is None or essential.shape != (3, 3):
            return None
        inliers = obeying[:, 0] > 0
        _, rotation, way, _ = cv2.recoverPose(essential, start[inliers], end[inliers], matrix)
        return RigidTransform(np.asarray(rotation, float), np.asarray(way[:, 0], float)), float(inliers.mean())

    def _triangulated(self, a: int, b: int, focal: float, motion: RigidTransform) -> Map:
        """(h, w) depth of ``a`` in lengths of the way to ``b``; NaN where it is not well above nothing."""
        camera = self._camera(focal)
        start = grid_pixels(camera.size, 1)
        end = start + self._flow(a, b).reshape(-1, 2)
        ray, towards = camera.rays(start), camera.rays(end)
        inverse, across = inverse_ranges_of_rays(towards, ray, motion)
        normal = np.cross(motion.translation, ray @ motion.rotation.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            off_px = np.abs((towards * normal).sum(1)) / np.linalg.norm(normal, axis=1) * camera.matrix[0, 0]
            sigma = _FLOW_SIGMA_PX / camera.matrix[0, 0] / across
            certain = self._returning(a, b).ravel() & (off_px < _EPIPOLAR_PX) & (inverse > _CERTAIN_SIGMAS * sigma)
            depth = np.where(certain, ray[:, 2] / inverse, np.nan)
        return depth.astype(np.float32).reshape(self._grey[a].shape)

    def _camera(self, focal: float) -> PinholeCamera:
        height, width = self._grey[0].shape
        f = focal * max(height, width)
        return PinholeCamera(np.array([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]]), (width, height))


def main() -> None:
    """Make one clip."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--focal", default="find", help="focal length in lengths of the longer side, or find (default)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every Nth picture, up to 90 of them")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        focal = None if arguments.focal == "find" else float(arguments.focal)
        clip = clip_of(_pictures(arguments.video, arguments.every), focal)
    except ValueError as error:
        raise SystemExit(f"{arguments.video}: {error}") from None
    clip.save(arguments.out)
    _draw(clip, arguments.out.with_suffix(".png"))
    known = np.isfinite(clip.depth).mean()
    print(f"{arguments.out}: {len(clip.images)} pictures, depth of {known:.0%}, focal length {clip.focal_px:.0f} px")


def _pictures(video: Path, every: int) -> list[Image]:
    """RGB, no longer than `LONG_SIDE_PX`."""
    capture, pictures = cv2.VideoCapture(str(video)), list[Image]()
    while len(pictures) < 90 and (read := capture.read())[0]:
        height, width = read[1].shape[:2]
        scale = min(1.0, LONG_SIDE_PX / max(height, width))
        size = (round(width * scale) // 4 * 4, round(height * scale) // 4 * 4)
        pictures.append(np.asarray(cv2.resize(read[1], size, interpolation=cv2.INTER_AREA)[:, :, ::-1], np.uint8))
        for _ in range(every - 1):
            capture.grab()
    if len(pictures) < 3:
        raise ValueError("no video, or too few pictures")
    return pictures


def _draw(clip: Clip, file: Path) -> None:
    """Six of its pictures over their depth: near is red, far is blue, unknown is black."""
    columns = []
    for k in np.linspace(0, len(clip.images) - 1, min(6, len(clip.images))).astype(int):
        depth = clip.depth[k].astype(np.float32)
        shade = 255 * (1 - np.clip((np.log(np.nan_to_num(depth, nan=1.0)) + 2) / 4, 0, 1))
        colours = cv2.applyColorMap(shade.astype(np.uint8), cv2.COLORMAP_TURBO)
        colours[np.isnan(depth)] = 0
        columns.append(np.vstack([clip.images[k][:, :, ::-1], colours]))
    cv2.imwrite(str(file), cv2.resize(np.hstack(columns), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    main()
