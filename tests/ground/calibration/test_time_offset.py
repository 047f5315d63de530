"""The time offset that was calibrated is what frames in flight are given their attitude by."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

from flockd.core.config import DroneConfig
from flockd.core.config.source import SourceParameters
from flockd.core.messages import FrameSet, VehicleState
from flockd.onboard.daemon.pilot_loop import PilotLoop
from tests.onboard.recording.made_up import drone_config


def test_frames_get_the_attitude_of_their_own_moment() -> None:
    plain = drone_config()
    rig = plain.rig.model_copy(update={"time_offset_s": 0.0437})
    config = DroneConfig(rig=rig, source=SourceParameters(kind="shared_memory", set_tolerance_s=0.01), step_s=0.1)
    asked = []

    def vehicle_at(time_s: float) -> VehicleState | None:
        asked.append(time_s)
        return None

    anything: Any = None
    sets = [FrameSet(100.0, {})]
    source: Any = SimpleNamespace(newest=lambda timeout_s=0.0: sets.pop() if sets else None)

    async def look() -> None:
        sight = PilotLoop(config, source, anything, vehicle_at, anything, anything, asyncio.get_running_loop().time)
        running = asyncio.create_task(sight.run())
        while not asked:
            await asyncio.sleep(0.01)
        running.cancel()

    asyncio.run(asyncio.wait_for(look(), 20.0))
    assert asked == [100.0437]
