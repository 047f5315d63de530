"""Each simulated drone's supervisor: it knows of wind, fence, heights and lost cameras; all else is well."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from flockd.core.config.safety import SafetyParameters
from flockd.flight.safety import (
    OFFBOARD,
    CameraHealth,
    Decision,
    Event,
    Inputs,
    State,
    Supervisor,
    Surroundings,
    outside_fence,
    outside_heights,
)

_SEES = CameraHealth(age_s=0.0, period_s=1.0, unplugged=False, frozen=False, noisy=False)
_LOST = replace(_SEES, unplugged=True)
_WELL = Inputs(
    cameras={"one": _SEES}, dropped_share=0.0, estimate_age_s=0.0, ego_motion_age_s=0.0, network_faults=0,
    inference_stuck=False, load=0.0, temperature_c=None, loop_lag_s=0.0, velocity_error_m_s=0.0, dead_tasks=(),
    neighbours_age_s=0.0, nearest_neighbour_m=math.inf, refused_commands=0, obstacle_near=False,
    outside_fence=False, outside_heights=False, motion_age_s=0.0,
    heartbeat_age_s=0.0, message_age_s=0.0, stream_fault=None, autopilot_failsafe=False, foreign_setpoints=None,
    parameter_fault=None, frame_jumped=False, flight_mode=OFFBOARD, armed=True, in_air=True, battery_low=False,
    position_lost=False, shutdown_asked=False, hold_asked=False, land_asked=False, resume_asked=False,
)  # fmt: skip


class WindSupervisor:
    """The supervisor of a drone that flies from the start on."""

    def __init__(self, parameters: SafetyParameters, cameras: Sequence[str]) -> None:
        """``cameras``: their names."""
        self._parameters, self._cameras = parameters, dict.fromkeys(cameras, _SEES)
        self.degraded_by: frozenset[Event] = frozenset()
        """Why the drone was last degraded: it flies slower for a while after that is over."""
        self._supervisor = Supervisor(parameters)
        for changes in ({"armed": False, "in_air": False, "flight_mode": "hold"}, {"flight_mode": "hold"}, {}):
            self._supervisor.step(-math.inf, replace(_WELL, **changes))

    def step(
        self, now_s: float, velocity_error_m_s: float, around: Surroundings, *, lost: Collection[str] = ()
    ) -> Decision:
        """As of `now_s`, so far off its setpoints; `lost`: the names of its lost cameras."""
        gate = self._parameters.gate
        inputs = replace(
            _WELL,
            cameras={**self._cameras, **dict.fromkeys(lost, _LOST)},
            velocity_error_m_s=velocity_error_m_s,
            obstacle_near=around.nearest_obstacle_m < self._parameters.hold_room_m,
            outside_fence=outside_fence(gate, around.position),
            outside_heights=outside_heights(gate, around.height_m),
        )
        decision = self._supervisor.step(now_s, inputs)
        if decision.state is State.DEGRADED and decision.reasons:
            self.degraded_by = frozenset(reason.event for reason in decision.reasons)
        return decision
