"""Sends the local map to the autopilot, whose Collision Prevention stops a pilot who flies by hand.

It is sent in every mode: with CP_DIST set and no map, PX4 refuses a pilot's takeover into Position mode and holds.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence

import numpy as np

from flockd.core import services
from flockd.core.config import DroneConfig
from flockd.core.messages import FloatArray, Neighbour
from flockd.flight.obstacles import free_ahead, nearest_points
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.daemon.pilot_loop import PilotLoop
from flockd.onboard.daemon.vehicle_history import VehicleHistory


class ObstacleDistances:
    """Sends nothing of a map that is old or whose place is not known: PX4 then stops in Position mode."""

    def __init__(
        self,
        config: DroneConfig,
        link: AutopilotLink,
        pilot_loop: PilotLoop,
        history: VehicleHistory,
        clock: Callable[[], float],
    ) -> None:
        self._parameters, self._timeout_s = config.obstacles, config.safety.estimate_timeout_s
        self._link, self._pilot_loop, self._history, self._clock = link, pilot_loop, history, clock

    async def run(self) -> None:
        """Sends until cancelled."""
        while True:
            free_m = self._free_ahead(self._clock())
            if free_m is not None:
                self._link.send_obstacle_distances(free_m, self._parameters.range_m)
            await asyncio.sleep(services.OBSTACLE_DISTANCE.period_s)

    def _free_ahead(self, now_s: float) -> FloatArray | None:
        """Of now, see `free_ahead`; None: nothing is known for sure."""
        result, vehicle = self._pilot_loop.newest, self._link.vehicle_state()
        if result is None or vehicle is None or result.output.obstacles is None:
            return None
        age_s = now_s - result.time_s
        if age_s > self._timeout_s or now_s - vehicle.time_s > services.MOTION.timeout:
            return None
        p, ranges, R = self._parameters, result.output.obstacles, vehicle.R_ned_body
        moved = self._history.moved_since(result.time_s)
        drones = _drones(result.output.neighbours, age_s, moved, p.height_band_m, p.sigmas)
        points = np.concatenate([nearest_points(ranges, p.sigmas) - moved[:2], drones])
        yaw_rad = math.atan2(R[1, 0], R[0, 0])
        return free_ahead(points, ranges.seen_m, float(np.linalg.norm(moved[:2])), yaw_rad, p.range_m)


def _drones(
    neighbours: Sequence[Neighbour], age_s: float, moved: FloatArray, band_m: float, sigmas: float
) -> FloatArray:
    """(m, 2) metres north and east: neighbours at the drone's height, each as near as it may be by now.

    The map leaves detected drones out.
    """
    points = np.empty((0, 2))
    for one in neighbours:
        place = one.position + age_s * one.velocity - moved
        away_m = float(np.hypot(*place[:2]))
        if one.confirmed and abs(place[2]) <= band_m and away_m > 0.0:
            nearest_m = max(away_m - sigmas * one.position_sigma_m, 0.0)
            points = np.vstack([points, nearest_m / away_m * place[:2]])
    return points
