"""The time offset that was calibrated is what frames in flight are given their attitude by."""

from __future__ import annotations

import asyncio
from typing import Any

from flockd.core.config import DroneConfig
from flockd.core.config.source import SourceParameters
from flockd.core.messages import FrameSet, VehicleState
from flockd.onboard.daemon.pilot_loop import PilotLoop
from tests.onboard.recording.made_up import drone_config


class OneSet:
    """A source that has one set of frames and then no more."""

    def __init__(self) -> None:
        self._sets = [FrameSet(100.0, {})]

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
        return self._sets.pop() if self._sets else None


def test_frames_get_the_attitude_of_their_own_moment() -> None:
    plain = drone_config()
    rig = plain.rig.model_copy(update={"time_offset_s": 0.0437})
    config = DroneConfig(rig=rig, source=SourceParameters(kind="shared_memory"), step_s=0.01)
    asked = []

    def vehicle_at(time_s: float) -> VehicleState | None:
        asked.append(time_s)
        return None

    anything: Any = None
    source: Any = OneSet()

    async def look() -> None:
        sight = PilotLoop(config, source, anything, vehicle_at, anything, anything, asyncio.get_running_loop().time)
        running = asyncio.create_task(sight.run())
        while not asked:
            await asyncio.sleep(0.01)
        running.cancel()

    asyncio.run(asyncio.wait_for(look(), 20.0))
    assert asked == [100.0437]
