"""From the segmentation network's maps to separate drones: each pixel votes for the centre of its drone."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from flockd.core.messages import Float32Array, FloatArray, UInt8Array

_CELL = 2
"""Side of the cells in which votes are counted, in map pixels, as the bins of a Hough transform (Ballard 1981)."""
_MAX_INSTANCES = 48
"""Instances in one image; the weakest are joined to the others. Far more than a flock has in view: it limits the time
that a faulty output costs in crops."""


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
    """Highest logit of its pixels minus the threshold of a pixel; the higher, the likelier a drone."""
    evidence: float = 0.0
    """Log odds of a drone by a detector; they are added to the second stage's."""
    boxed: bool = False
    """Whether the box comes from a detector, and so shows the whole drone."""


def group_instances(
    drone_logit: Float32Array, offset: Float32Array, *, scale: int, min_area_px: float = 10.0
) -> tuple[UInt8Array, tuple[Instance, ...]]:
    """Splits a mask into drones by the centres that its pixels point to.

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
    votes = np.array([columns + 0.5 + offset[0, rows, columns], rows + 0.5 + offset[1, rows, columns]]).T
    centres = _vote_peaks(votes, (height, width))
    nearest = cKDTree(centres).query(votes)[1]
    sizes = np.bincount(nearest, minlength=len(centres))
    some = sizes.nonzero()[0]
    count = sizes[some]
    first = np.cumsum(count) - count
    by_centre = np.argsort(nearest, kind="stable")
    pixels = np.array([columns, rows])[:, by_centre]
    corners = np.minimum.reduceat(pixels, first, axis=1), np.maximum.reduceat(pixels, first, axis=1) + 1
    boxes = scale * np.concatenate(corners).T.astype(np.float64)
    scores = np.maximum.reduceat(drone_logit[rows, columns][by_centre], first).tolist()
    ordered = np.array([axis[np.lexsort((axis, nearest))] for axis in votes.T]).T
    medians = scale * (ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2
    areas = scale**2 * count.astype(np.float64)
    largest_first = np.argsort(-areas, kind="stable")
    kept = largest_first[areas[largest_first] >= min_area_px].tolist()
    label_of = np.zeros(len(centres), np.uint8)
    label_of[some[kept]] = np.arange(1, len(kept) + 1)
    labels[rows, columns] = label_of[nearest]
    return labels, tuple(
        Instance(label, medians[k], boxes[k], float(areas[k]), scores[k]) for label, k in enumerate(kept, start=1)
    )


def _vote_peaks(votes: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """(k, 2) peaks of the votes, the strongest first; at least one."""
    margin = 32  # centres may lie outside the image
    size = np.array([shape[1], shape[0]])
    cell = np.clip((votes + margin) // _CELL, 0, (size + 2 * margin) // _CELL - 1).astype(np.int64)
    down, right = (shape[0] + 2 * margin) // _CELL, (shape[1] + 2 * margin) // _CELL
    counts = np.bincount(cell[:, 1] * right + cell[:, 0], minlength=down * right)
    grid = counts.reshape(down, right).astype(np.float32)
    smooth = cv2.GaussianBlur(grid, (0, 0), 1.0)
    peak = (smooth >= cv2.dilate(smooth, np.ones((5, 5), np.uint8))) & (smooth > 0.15)
    rows, columns = np.nonzero(peak)
    strength = smooth[rows, columns]
    order = np.argsort(-strength, kind="stable")
    places = (np.array([columns, rows]).T + 0.5) * _CELL - margin
    votes_right, votes_down = np.ascontiguousarray(votes.T)
    kept: list[FloatArray] = []
    places = places[order]
    while len(places) and len(kept) < _MAX_INSTANCES:
        place = places[0]
        kept.append(place)
        # A side lobe of a big drone's votes is weaker and close by; another drone's votes are as strong as this one's.
        own = (np.abs(votes_right - place[0]) < 6) & (np.abs(votes_down - place[1]) < 6)
        reach = 3.0 + 0.35 * np.sqrt(np.count_nonzero(own))
        places = places[np.hypot(*(places - place).T) >= reach]
    return np.array(kept) if kept else np.median(votes, axis=0)[None]
