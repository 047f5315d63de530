"""Whether what each camera sees moves as the drone does: one that hangs upside down, or is another one, does not."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.consistency import RANGE_VISION
from flockd.core.messages import VehicleState
from flockd.flight.geometry import PointPairs, Rig, RigidTransform, moved_pixels
from flockd.flight.pilot.own_motion import ERROR_M_S

_MOVED_PX, _FEWEST = 2.0, 40
"""A pair that moved less has no direction; fewer pairs tell nothing."""
_TIME_S, _SURE = 8.0, 0.4
"""Time that looks count for, and the mean from which on a camera agrees or not: after four seconds if all do alike."""


def moves_otherwise(camera: str) -> str:
    """What is said of a camera that does not."""
    return f"camera {camera}: it moves otherwise than the drone: is it the one of that name, turned as configured?"


class CameraAgreement:
    """Compares the flow of each camera with what the autopilot's motion, of which no camera knows, would make it.

    By the mean turn from one to the other, as complex numbers of length 1: near 1 where they agree, however wrong the
    scale of the depths; near -1 upside down, i on its side, and 0, which tells nothing, where flow is wrong at random.
    Pairs that move by the drone's turn and those that move by its translation each have to agree: ahead and astern an
    image that is upside down shows the same translation, and one from the other side may show the same turn.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._agreements = dict.fromkeys(rig.cameras, 0.0)
        """Mean of the last looks while the drone moved: 1 agrees, -1 contradicts."""

    @np.errstate(all="ignore")  # a velocity that no drone has tells nothing
    def see(self, before: VehicleState, after: VehicleState, interval_s: float, pairs: PointPairs) -> None:
        """Takes what stood still between two frame sets; tells nothing where the autopilot knows no velocity."""
        if before.velocity_ned is None or after.velocity_ned is None:
            return
        velocity = before.R_ned_body.T @ (before.velocity_ned + after.velocity_ned) / 2.0
        if np.linalg.norm(velocity) < RANGE_VISION.limit * ERROR_M_S:
            return
        turn, gain = before.R_ned_body.T @ after.R_ned_body, 1.0 - math.exp(-interval_s / _TIME_S)
        turned, moved = RigidTransform(turn, np.zeros(3)), RigidTransform(turn, velocity * interval_s)
        for name, camera in self._rig.cameras.items():
            mine = pairs.select(pairs.camera_names == name)
            ends = moved_pixels(camera, mine.previous, turned), moved_pixels(camera, mine.previous, moved)
            by_turn, by_both, seen = (
                (end - mine.pixels_previous) @ [1.0, 1.0j] for end in (*ends, mine.pixels_current)
            )
            told, far = (abs(by_both) > _MOVED_PX) & (abs(seen) > _MOVED_PX), abs(by_both - by_turn) < abs(by_turn)
            groups = [group for group in (told & far, told & ~far) if np.count_nonzero(group) >= _FEWEST]
            turns = np.array([np.mean(np.exp(1.0j * np.angle(seen[group] / by_both[group]))) for group in groups])
            if len(turns):  # above zero within 45 degrees
                self._agreements[name] += gain * (float((turns.real - abs(turns.imag)).min()) - self._agreements[name])

    def elsewhere(self) -> tuple[str, ...]:
        """Cameras to fly without: none where more contradict the autopilot than agree, as it may be what errs."""
        found = tuple(name for name, agreement in self._agreements.items() if agreement < -_SURE)
        return found if len(found) <= sum(agreement > _SURE for agreement in self._agreements.values()) else ()
