"""A pilot flies by hand, and flockd tells the autopilot what it sees of obstacles. The autopilot is a fake, not PX4."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import FloatArray
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.ground_station import GroundStation
from flockd.sim.sitl.ports import free_port
from tests.calm import clock
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import CAMERAS, SECONDS_TO_FAIL, aboard

NEAR_M, FAR_M = 3.0, 8.0
"""`TinyPerceiver` shows walls 5 to 7 m away before each camera, ahead and behind; nobody looks aside."""
ASIDE, RIGHT = np.array([math.cos(math.radians(35.0)), math.sin(math.radians(35.0))]), np.array([0.0, 1.0])
"""Half ahead: pictures 64 pixels wide show nothing in some sectors nearer to the nose."""


def looking(config: DroneConfig) -> DroneConfig:
    return config.model_copy(update={"obstacles": ObstacleParameters(enabled=True, min_pixels=1)})


def telling(config: DroneConfig) -> DroneConfig:
    assert config.autopilot is not None
    autopilot = config.autopilot.model_copy(update={"obstacle_distance": True})
    return looking(config).model_copy(update={"autopilot": autopilot})


async def test_a_pilot_is_stopped_before_what_flockd_sees_and_where_it_has_not_looked(tmp_path: Path) -> None:
    port, truth = free_port(), free_port()
    with (
        FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, truth_port=truth, clock=clock) as autopilot,
        GroundStation([truth], clock) as station,
    ):
        autopilot.drifts = False
        async with aboard(autopilot, port, tmp_path, change=telling) as ship:
            await until(lambda: autopilot.collision_prevention.without_data_s(clock()) < 1.0, SECONDS_TO_FAIL)
            autopilot.parameters["CP_DIST"] = NEAR_M
            autopilot.pilot_selects("POSCTL")

            async def flown(way: FloatArray) -> float:
                """(m/s) the fastest of a push at the sticks, along it."""
                fastest = 0.0
                for _ in range(20):
                    station.steer(0, way)
                    await asyncio.sleep(0.05)
                    fastest = max(fastest, float(autopilot.state.velocity[:2] @ way))
                await until(lambda: float(np.linalg.norm(autopilot.state.velocity[:2])) < 0.05, SECONDS_TO_FAIL)
                return fastest

            assert await flown(ASIDE) > 0.5, "there is room"
            assert await flown(RIGHT) < 0.1, "no camera looks there"
            autopilot.parameters["CP_DIST"] = FAR_M
            assert await flown(ASIDE) < 0.1, "the wall is nearer"
            assert autopilot.mode == "POSCTL"

            autopilot.parameters["CP_DIST"] = NEAR_M
            ship.cameras.silent |= set(CAMERAS)
            await until(lambda: autopilot.collision_prevention.without_data_s(clock()) > 0.6, SECONDS_TO_FAIL)
            assert await flown(ASIDE) < 0.1, "the map is old, and is sent no more"
            await until(lambda: autopilot.mode == "LOITER", SECONDS_TO_FAIL)
            await until(lambda: "flockd idle" in station.last_text(0), SECONDS_TO_FAIL)


async def test_without_the_key_nothing_is_sent_of_obstacles(tmp_path: Path) -> None:
    port = free_port()
    with FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, clock=clock) as autopilot:
        async with aboard(autopilot, port, tmp_path, change=looking) as ship:
            await until(lambda: "READY=1" in ship.service, SECONDS_TO_FAIL)
            await until(lambda: "command" in ship.heard(), SECONDS_TO_FAIL)
            await asyncio.sleep(0.5)
            assert np.isinf(autopilot.collision_prevention.without_data_s(clock()))
