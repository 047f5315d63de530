"""From the segmentation network's maps to separate drones: pixels vote for the centre that they belong to."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flockd.messages import Float32Array, FloatArray, UInt8Array

_CELL = 2
"""Map pixels: the side of the cells in which votes are counted, as the bins of a Hough transform (Ballard 1981)."""
_MAX_INSTANCES = 48
"""In one image; the weakest are joined to the others. Far more than the drones of a flock in view: it bounds the time
of a faulty output, as every instance costs crops."""


@dataclass(frozen=True, eq=False)
class Instance:
    """One drone in one image, in pixels of the full image."""

    label: int
    centre: FloatArray
    """(2,) u, v of the drone's centre; may lie outside the image."""
    box: FloatArray
    """(4,) left, top, right, bottom of its pixels."""
    area_px: float
    score: float = 0.0
    """By how much the highest logit of its pixels exceeds the threshold of a pixel; the more, the likelier a drone."""


def group_instances(
    drone_logit: Float32Array, offset: Float32Array, *, scale: int, min_area_px: float = 10.0
) -> tuple[UInt8Array, tuple[Instance, ...]]:
    """Split a mask into drones by the centres its pixels point to.

    Args:
        drone_logit: (h, w) at a ``scale``-th of the image's size; above 0 is drone.
        offset: (2, h, w) map pixels from each pixel to its drone's centre, right and down.
        scale: image pixels per map pixel.
        min_area_px: smaller groups, in image pixels, are dropped.

    Returns:
        labels (h, w), 0 for background and then 1, 2, ...; and the drones, largest first.
    """
    height, width = drone_logit.shape
    labels = np.zeros((height, width), np.uint8)
    rows, columns = np.nonzero(drone_logit > 0)
    if rows.size == 0:
        return labels, ()
    votes = np.stack([columns + 0.5 + offset[0, rows, columns], rows + 0.5 + offset[1, rows, columns]], 1)
    centres = _vote_peaks(votes, (height, width))
    right, down = (votes[:, None, axis] - centres[None, :, axis] for axis in (0, 1))
    nearest = np.argmin(right**2 + down**2, axis=1)
    found = []
    for index in range(len(centres)):
        mine = nearest == index
        area = float(mine.sum()) * scale**2
        if area < min_area_px:
            continue
        u, v = columns[mine], rows[mine]
        box = scale * np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], np.float64)
        score = float(drone_logit[v, u].max())
        found.append((area, scale * np.median(votes[mine], axis=0), box, mine, score))
    found.sort(key=lambda item: -item[0])
    instances = []
    for label, (area, centre, box, mine, score) in enumerate(found, start=1):
        labels[rows[mine], columns[mine]] = label
        instances.append(Instance(label, centre, box, area, score))
    return labels, tuple(instances)


def _vote_peaks(votes: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """(k, 2) places where votes gather, the strongest first; at least one."""
    margin = 32  # centres may lie outside the image
    size = np.array([shape[1], shape[0]])
    cell = np.clip((votes + margin) // _CELL, 0, (size + 2 * margin) // _CELL - 1).astype(np.int64)
    grid = np.zeros(((shape[0] + 2 * margin) // _CELL, (shape[1] + 2 * margin) // _CELL), np.float32)
    np.add.at(grid, (cell[:, 1], cell[:, 0]), 1.0)
    smooth = cv2.GaussianBlur(grid, (0, 0), 1.0)
    peak = (smooth >= cv2.dilate(smooth, np.ones((5, 5), np.uint8))) & (smooth > 0.15)
    rows, columns = np.nonzero(peak)
    strength = smooth[rows, columns]
    order = np.argsort(-strength, kind="stable")
    kept: list[FloatArray] = []
    strongest: list[float] = []
    for i in order:
        place = (np.array([columns[i], rows[i]]) + 0.5) * _CELL - margin
        # A side lobe of a big drone's votes is weaker and close by; another drone stands on its own feet.
        near = any(
            np.hypot(*(place - other)) < 3.0 + 0.35 * np.sqrt(w) for other, w in zip(kept, strongest, strict=True)
        )
        if not near:
            if len(kept) == _MAX_INSTANCES:
                break
            kept.append(place)
            right, down = (np.abs(votes[:, axis] - place[axis]) < 6 for axis in (0, 1))
            strongest.append(float((right & down).sum()))
    if not kept:
        kept.append(np.median(votes, axis=0))
    return np.array(kept)
