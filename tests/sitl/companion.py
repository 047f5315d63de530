"""A companion computer's program, which sends setpoints until it is killed: PORT, NORTH_M_S."""

from __future__ import annotations

import asyncio
import sys
import time

import numpy as np

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.messages import Setpoint
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink

HEIGHT_M = 4.0
SETPOINTS_HZ = 20.0
START_S = 120.0


async def _send_setpoints(port: str, north_m_s: float) -> None:
    """North at this speed, at the height where it is."""
    address = f"udpin://127.0.0.1:{port}"
    link = await AutopilotLink.connect(AutopilotParameters(address=address), timeout_s=START_S)
    velocity = np.array([north_m_s, 0.0])
    attending = asyncio.create_task(link.attend())  # it announces flockd, so that the autopilot's texts are sent
    print("streaming", flush=True)  # noqa: T201
    while not attending.done():
        link.send_setpoint(Setpoint(time.monotonic(), velocity, height_m=HEIGHT_M, yaw_rad=0.0))
        await asyncio.sleep(1.0 / SETPOINTS_HZ)


if __name__ == "__main__":
    asyncio.run(_send_setpoints(sys.argv[1], float(sys.argv[2])))
