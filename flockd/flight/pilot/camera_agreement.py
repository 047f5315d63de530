"""Detects cameras whose images do not move as the drone does: mounted upside down, or swapped with another one."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.consistency import RANGE_VISION
from flockd.core.messages import VehicleState
from flockd.flight.geometry import PointPairs, Rig, RigidTransform, moved_pixels
from flockd.flight.pilot.own_motion import ERROR_M_S

_MOVED_PX, _FEWEST = 2.0, 40
"""Least displacement of a point, px, with a direction, and least number of such points in a step."""
_TIME_S, _SURE = 8.0, 0.4
"""Time constant in s, and the mean beyond which a camera agrees or contradicts: four seconds if all points do."""


def moves_otherwise(camera: str) -> str:
    """The message for a camera that contradicts the autopilot."""
    return f"camera {camera}: it moves otherwise than the drone: is it the one of that name, turned as configured?"


class CameraAgreement:
    """Compares each camera's optical flow with the flow that the autopilot's motion predicts.

    The mean of exp(i angle), from predicted to measured flow, does not depend on the scale of depth. It is near 1 where
    they agree, -1 for a camera upside down, i for one on its side, and 0, undecided, where the flow is wrong at random.
    Points that move mostly by rotation and points that move mostly by translation have to agree separately. An image
    upside down looks the same under translation ahead and astern, and one from the opposite side may look the same
    under rotation.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._agreements = dict.fromkeys(rig.cameras, 0.0)
        """Mean agreement of each camera while the drone moved: 1 agrees, -1 contradicts."""

    @np.errstate(all="ignore")  # an impossible velocity gives NaN, which is not counted
    def see(self, before: VehicleState, after: VehicleState, interval_s: float, pairs: PointPairs) -> None:
        """Updates the agreements with the background points of two frame sets. Needs the autopilot's velocity."""
        if before.velocity_ned is None or after.velocity_ned is None:
            return
        velocity = before.R_ned_body.T @ (before.velocity_ned + after.velocity_ned) / 2.0
        if np.linalg.norm(velocity) < RANGE_VISION.limit * ERROR_M_S:
            return
        turn, gain = before.R_ned_body.T @ after.R_ned_body, 1.0 - math.exp(-interval_s / _TIME_S)
        turned, moved = RigidTransform(turn, np.zeros(3)), RigidTransform(turn, velocity * interval_s)
        for name, camera in self._rig.cameras.items():
            mine = pairs[pairs.camera_names == name]
            ends = moved_pixels(camera, mine.previous, turned), moved_pixels(camera, mine.previous, moved)
            by_turn, by_both, seen = (
                (end - mine.pixels_previous) @ [1.0, 1.0j] for end in (*ends, mine.pixels_current)
            )
            told, far = (abs(by_both) > _MOVED_PX) & (abs(seen) > _MOVED_PX), abs(by_both - by_turn) < abs(by_turn)
            groups = [group for group in (told & far, told & ~far) if np.count_nonzero(group) >= _FEWEST]
            turns = np.array([np.mean(np.exp(1.0j * np.angle(seen[group] / by_both[group]))) for group in groups])
            if len(turns):  # positive if the angle is below 45 degrees
                self._agreements[name] += gain * (float((turns.real - abs(turns.imag)).min()) - self._agreements[name])

    def elsewhere(self) -> tuple[str, ...]:
        """Cameras that contradict the autopilot; empty if they outnumber those that agree: it may be wrong."""
        found = tuple(name for name, agreement in self._agreements.items() if agreement < -_SURE)
        return found if len(found) <= sum(agreement > _SURE for agreement in self._agreements.values()) else ()
