"""Training samples for verification that look like a real camera's: softened renderings, composites, real crops.

Each has a ``picture`` (96, 96, 3), ``drone`` (1: there is one) and ``exists_weight``, how much it counts.

Positives and negatives pass through the same cameras: else a network learns that what is soft is a drone.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.training.camera_effects import drawn_effects, through_camera
from tools.training.real_patches import CROP_PX, RealPatches, crop_of_drone, crop_of_negative

Sample = dict[str, NDArray[Any]]
Image = NDArray[np.uint8]
WIDTHS_PX = (6.0, 240.0)
"""How wide a softened drone is in the camera's image, evenly by its logarithm. Cut-outs have no more pixels."""
_LIKE_BEHIND = 0.25
"""Share of composites whose drone is nearly as bright as its background."""
_NEGATIVE_SCALES = (0.4, 1.0)
_LEAST_SCALE = 0.07
_TRIES = 6
_NOISE_SIGMA = (40.0, 120.0)
_SENSOR_SIGMA = 6.0
"""Grey levels that noise and compression hide at least."""
_TEXTURE_SIGMA = 30.0
"""What the background's texture hides at most."""
_SURELY_VISIBLE = 40.0
"""Energy of what a drone changes in the camera's image, over the variance of what hides it. Less counts less, in
proportion: who is taught drones that cannot be seen learns to see them everywhere."""


def softened(sample: Sample, rng: np.random.Generator) -> Sample:
    """A rendered sample as a real camera shows a drone of ``WIDTHS_PX``."""
    width_px = _drawn_width(rng)
    scale = _scale(sample, width_px)
    seen = visibility(sample["picture"], sample["mask"], scale) if sample["drone"] > 0.5 else 1.0
    picture = through_camera(sample["picture"], drawn_effects(scale, rng), rng)
    return _sample(picture, drone=float(sample["drone"]), weight=seen)


def sharp(sample: Sample) -> Sample:
    """A rendered sample as it is."""
    return _sample(sample["picture"], drone=float(sample["drone"]))


def composite(sample: Sample, backgrounds: RealPatches, rng: np.random.Generator) -> Sample:
    """The sample's drone, repainted, in front of a real background, through a real camera."""
    image, seen, scale = sample["picture"], 0.0, 1.0
    share = sample["mask"][:, :, None].astype(np.float32) / 255
    for _ in range(_TRIES):
        patch, half_px, _ = backgrounds.draw(rng)
        behind, camera_px = crop_of_negative(patch, half_px, rng)
        # A background that is softer than the drone before it would give the drone away.
        width_px = min(_drawn_width(rng), camera_px * _shown_px(sample))
        if width_px < WIDTHS_PX[0]:
            continue
        own = repainted(sample["picture"], rng)
        if rng.random() < _LIKE_BEHIND:
            own = _as_bright(own, share, behind, rng)
        painted = share * own + (1 - share) * behind
        image, scale = np.clip(np.round(painted), 0, 255).astype(np.uint8), _scale(sample, width_px)
        seen = visibility(image, sample["mask"], scale, behind)
        if seen >= 1.0:
            break
    picture = through_camera(image, drawn_effects(scale, rng), rng)
    return _sample(picture, drone=1.0, weight=seen)


def _as_bright(
    own: NDArray[np.float32], share: NDArray[np.floating[Any]], behind: Image, rng: np.random.Generator
) -> NDArray[np.float32]:
    """The drone's colours, nearly as bright as what is behind it."""
    mine = float((share * own).mean() / max(float(share.mean()), 1e-3))
    wanted = float((share * behind).mean() / max(float(share.mean()), 1e-3))
    factor = np.float32(1 + rng.uniform(0.3, 0.9) * (wanted / max(mine, 1.0) - 1))
    return np.asarray(own * factor, np.float32)


def visibility(picture: Image, mask: Image, scale: float, behind: Image | None = None) -> float:
    """0-1: how sure one can be at a ``scale`` of the picture (h, w, 3) that something is there.

    ``behind`` shows the same without the drone; without it, the colour around the drone stands for it.
    """
    share = mask[:, :, None].astype(np.float32) / 255
    around = cv2.dilate(mask, np.ones((5, 5), np.uint8)) == 0
    if not around.any():
        return 1.0
    free = picture[around].astype(np.float32)
    hidden = free.mean(0) if behind is None else behind.astype(np.float32)
    size = (max(2, round(scale * picture.shape[1])), max(2, round(scale * picture.shape[0])))
    change = cv2.resize(share * (picture - hidden), size, interpolation=cv2.INTER_AREA)
    texture = min(float(free.std(0).mean()), _TEXTURE_SIGMA)
    energy = float((change.max(2) ** 2 + change.min(2) ** 2).sum()) / 2 / (_SENSOR_SIGMA**2 + texture**2)
    # However large it is, a drone of which no pixel stands out of the noise cannot be seen.
    return min(1.0, energy / _SURELY_VISIBLE, (float(np.abs(change).max()) / (2 * _SENSOR_SIGMA)) ** 2)


def repainted(picture: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    """The same in another paint and light: white shells, black carbon, or as it was."""
    values = picture.astype(np.float32)
    kind = rng.random()
    if kind < 0.3:
        values = 255 - (255 - values) * rng.uniform(0.15, 0.6)
    elif kind < 0.5:
        values = values * rng.uniform(0.25, 0.8)
    painted = np.clip(values * np.exp(rng.normal(0, 0.1, 3)) + rng.normal(0, 8), 0, 255)
    return np.asarray(painted, np.float32)


def negative(patch: Image, half_px: float, rng: np.random.Generator) -> Sample:
    """A real crop without a drone, from a patch of `RealPatches`; every other one through another camera as well."""
    picture, camera_px = crop_of_negative(patch, half_px, rng)
    if rng.random() < 0.5:
        scale = min(1.0, camera_px) * float(rng.uniform(*_NEGATIVE_SCALES))
        picture = through_camera(picture, drawn_effects(max(scale, _LEAST_SCALE), rng), rng)
    return _sample(picture, drone=0.0)


def noise(patch: Image, half_px: float, rng: np.random.Generator) -> Sample:
    """A real crop without a drone under so much noise that no drone could be seen, now and then noise alone."""
    picture, _ = crop_of_negative(patch, half_px, rng)
    side = int(rng.integers(CROP_PX // 4, CROP_PX + 1))
    channels = 3 if rng.random() < 0.7 else 1
    if rng.random() < 0.3:
        grain = rng.uniform(-255, 255, (side, side, channels))
        picture = np.full_like(picture, 128)
    else:
        grain = rng.normal(0, rng.uniform(*_NOISE_SIGMA), (side, side, channels))
    enlarged = cv2.resize(grain.astype(np.float32), (CROP_PX, CROP_PX), interpolation=cv2.INTER_LINEAR)
    spoilt = picture + enlarged.reshape(CROP_PX, CROP_PX, channels)
    return _sample(np.clip(np.round(spoilt), 0, 255).astype(np.uint8), drone=0.0)


def real_drone(drones: RealPatches, rng: np.random.Generator, *, backgrounds: RealPatches | None = None) -> Sample:
    """A real drone before the sky; with ``backgrounds`` cut out and put before one of them."""
    patch, half_px, box = drones.draw(rng)
    picture, inside, camera_px = crop_of_drone(patch, half_px, box, rng)
    share, seen = matte(picture, inside), 1.0
    scale = max(min(1.0, camera_px) * float(rng.uniform(0.6, 1.0)), _LEAST_SCALE)
    if backgrounds is not None:
        behind, _ = crop_of_negative(*backgrounds.draw(rng)[:2], rng)
        opaque = share[:, :, None]
        own = np.where(opaque > 0.05, (picture - (1 - opaque) * _sky(picture, inside)) / np.maximum(opaque, 0.05), 0)
        paint = rng.uniform(-30, 60)
        picture = np.clip(opaque * (own + paint) + (1 - opaque) * behind, 0, 255).astype(np.uint8)
        seen = visibility(picture, np.asarray(255 * share, np.uint8), scale, behind)
    if backgrounds is not None or rng.random() < 0.5:
        picture = through_camera(picture, drawn_effects(scale, rng), rng)
    return _sample(picture, drone=1.0, weight=seen)


def matte(picture: Image, box: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) how much of each pixel is the drone's, 0-1: what differs from the sky around the box, in it."""
    difference = np.abs(picture.astype(np.float32) - _sky(picture, box)).max(2)
    inside = np.zeros(difference.shape, np.bool_)
    left, top, right, bottom = _within(box, 3.0)
    inside[top:bottom, left:right] = True
    if not inside.any():
        return np.zeros(difference.shape, np.float32)
    noise = float(np.quantile(difference[~inside], 0.9)) if (~inside).any() else 0.0
    full = max(0.6 * float(np.quantile(difference[inside], 0.98)), noise + 8.0)
    return np.where(inside, np.clip((difference - noise) / (full - noise), 0, 1), 0).astype(np.float32)


def _sky(picture: Image, box: NDArray[np.float32]) -> NDArray[np.float32]:
    """(3,) colour around the box."""
    around = np.ones(picture.shape[:2], np.bool_)
    left, top, right, bottom = _within(box, 3.0)
    around[top:bottom, left:right] = False
    return np.asarray(np.median(picture[around] if around.any() else picture.reshape(-1, 3), axis=0), np.float32)


def _within(box: NDArray[np.float32], margin: float) -> tuple[int, int, int, int]:
    left, top = np.maximum(np.floor(box[:2] - margin), 0).astype(int)
    right, bottom = np.minimum(np.ceil(box[2:] + margin), CROP_PX).astype(int)
    return int(left), int(top), int(right), int(bottom)


def _drawn_width(rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(math.log(WIDTHS_PX[0]), math.log(WIDTHS_PX[1]))))


def _shown_px(sample: Sample) -> float:
    """How wide the drone is in the crop; where there is none, what would suit one."""
    return float(np.exp(sample["apparent"])) if sample["drone"] > 0.5 else 70.0


def _scale(sample: Sample, width_px: float) -> float:
    return min(1.0, width_px / _shown_px(sample))


def _sample(picture: Image, *, drone: float, weight: float = 1.0) -> Sample:
    return {
        "picture": picture,
        "drone": np.array(drone, np.float32),
        "exists_weight": np.array(weight, np.float32),
    }
