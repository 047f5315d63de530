"""Each simulated drone's supervisor: it knows of wind, fence, heights and lost cameras; all else is well."""

from __future__ import annotations

import math
from dataclasses import replace

from flockd.core.config.safety import SafetyParameters
from flockd.core.messages import FloatArray
from flockd.flight.safety import OFFBOARD, CameraHealth, Decision, Inputs, Supervisor, outside_fence, outside_heights

_SEES = CameraHealth(age_s=0.0, period_s=1.0, unplugged=False, frozen=False, noisy=False)
_LOST = replace(_SEES, unplugged=True)
_WELL = Inputs(
    cameras={"one": _SEES}, dropped_share=0.0, estimate_age_s=0.0, ego_motion_failures=0, network_faults=0,
    inference_stuck=False, load=0.0, temperature_c=None, loop_lag_s=0.0, gusts_m_s=0.0, dead_tasks=(),
    neighbours_age_s=0.0, nearest_neighbour_m=math.inf, refused_commands=0, outside_fence=False, outside_heights=False,
    motion_age_s=0.0,
    heartbeat_age_s=0.0, message_age_s=0.0, stream_fault=None, autopilot_failsafe=False, foreign_setpoints=None,
    parameter_fault=None, flight_mode=OFFBOARD, armed=True, in_air=True, offboard_refused=False, battery_low=False,
    position_lost=False, shutdown_asked=False, hold_asked=False, land_asked=False, resume_asked=False,
)  # fmt: skip


class WindSupervisor:
    """The supervisor of a drone that flies from the start on."""

    def __init__(self, parameters: SafetyParameters) -> None:
        self._parameters = parameters
        self._supervisor = Supervisor(parameters)
        for changes in ({"armed": False, "in_air": False, "flight_mode": "hold"}, {"flight_mode": "hold"}, {}):
            self._supervisor.step(-math.inf, replace(_WELL, **changes))

    def step(self, now_s: float, gusts_m_s: float, position: FloatArray, *, blind: bool = False) -> Decision:
        """As of `now_s`, at `position` (3,) m NED from home, carried off its setpoints by `gusts_m_s`.

        `blind`: one of its cameras is lost.
        """
        gate = self._parameters.gate
        inputs = replace(
            _WELL,
            cameras={"one": _SEES, "other": _LOST} if blind else _WELL.cameras,
            gusts_m_s=gusts_m_s,
            outside_fence=outside_fence(gate, position[:2]),
            outside_heights=outside_heights(gate, float(-position[2])),
        )
        return self._supervisor.step(now_s, inputs)
