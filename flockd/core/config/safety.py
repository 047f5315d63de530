"""The supervisor's limits, and those of the last gate before the autopilot."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core import consistency, services
from flockd.core.choices import AutopilotMode
from flockd.core.config.base import Duration, FromHome, Positive, Section, Share, refuse
from flockd.core.navigation import crosses_itself, is_inside

LOWEST_LAYER_M, LAYERS_APART_M = 3.0, 4.0
"""Of first flights: a metre more than `vertical_separation_m` for errors of two drones' heights."""


class GateParameters(Section):
    """The last limits on what is sent to the autopilot, whatever asks for it."""

    permission_timeout_s: Annotated[float, Field(gt=0, le=0.4)] = services.PERMISSION.timeout
    """The supervisor's permission is valid for this long: what has stalled sends nothing half a second later."""
    command_fresh_s: Annotated[float, Field(gt=0, le=60)] = services.WANTED.timeout
    """A command older than this is flown ever more slowly. Allow a step and its duration."""
    command_timeout_s: Annotated[float, Field(gt=0, le=60)] = services.WANTED_GONE.timeout
    """At this age of the command the drone stands still; it flies no older one. Allow three pilot's steps."""
    max_speed_m_s: Annotated[float, Field(gt=0, le=50)] = 4.0
    """A command that asks for more is a fault, and refused."""
    max_acceleration_m_s2: Annotated[float, Field(gt=0, le=50)] = 5.0
    degraded_speed_m_s: Annotated[float, Field(gt=0, le=50)] = 1.0
    """Instead, while the drone is degraded: a faster command is flown at this speed."""
    min_separation_m: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Nearer than this to a neighbour, no velocity towards it."""
    degraded_separation_m: Annotated[float, Field(ge=0, le=1000)] = 1.5
    """Instead, while the drone is degraded."""
    vertical_separation_m: Annotated[float, Field(ge=0, le=1000)] = 3.0
    """A neighbour that is above or below by less than this counts as one at the drone's height. No change of height
    leads nearer to one whose level distance is within one and a half times `degraded_separation_m`: the lower flies in
    the other's downwash."""
    max_climb_m_s: Annotated[float, Field(gt=0, le=20)] = 1.5
    """The height setpoint changes no faster than this, up or down."""
    braking_m_s2: Annotated[float, Field(gt=0, le=20)] = 1.5
    """How hard every drone of the flock can brake: none flies faster towards a neighbour or an obstacle than it can
    stop in time."""
    obstacle_clearance_m: Annotated[float, Field(ge=0, le=100)] = 0.6
    """From the drone's middle to an obstacle's surface: nearer than this, no velocity towards it."""
    reaction_s: Annotated[float, Field(gt=0, le=5)] = 0.5
    """From seeing an obstacle until the own drone has begun to brake. Its velocity is expected to follow its setpoints
    with this time constant."""
    neighbour_reaction_s: Annotated[float, Field(ge=0, le=5)] = 1.0
    """From a neighbour's change of velocity until the own drone begins to brake: the rest of a step, in which the
    change is not seen, the computation of the next one, and the drone's response."""
    fence_radius_m: Annotated[float, Field(gt=0, le=100_000)] | None = 100.0
    """Around home, level: the drone brakes before it as before an obstacle; beyond it only inward velocity. null: no
    circle."""
    fence_corners_m: tuple[tuple[FromHome, FromHome], ...] = ()
    """A fence of any shape: its corners north and east of home, in order. With a radius too, both hold."""
    min_height_m: Annotated[float, Field(ge=-1000, le=10_000)] = 1.0
    max_height_m: Annotated[float, Field(ge=-1000, le=10_000)] = 30.0

    @model_validator(mode="after")
    def _limits_agree(self) -> Self:
        for small, large in (("command_fresh_s", "command_timeout_s"), ("min_height_m", "max_height_m")):
            if getattr(self, small) >= getattr(self, large):
                raise ValueError(f"{small} {getattr(self, small):g} is not below {large}; write a smaller one")
        if self.neighbour_reaction_s < self.reaction_s:
            told = f"neighbour_reaction_s is below reaction_s {self.reaction_s:g}, a part of it"
            raise ValueError(f"{told}; write a larger one")
        if self.degraded_speed_m_s > self.max_speed_m_s:
            raise ValueError("degraded_speed_m_s is above max_speed_m_s; write a smaller one")
        if self.degraded_separation_m < self.min_separation_m:
            raise ValueError("degraded_separation_m is below min_separation_m; write a larger one")
        if 0 < len(self.fence_corners_m) < 3:
            raise ValueError("fence_corners_m has fewer than 3 corners; add the others, or delete it")
        if len(set(self.fence_corners_m)) < len(self.fence_corners_m):
            raise ValueError("fence_corners_m names a corner twice; delete one, the fence closes by itself")
        if crosses_itself(self.fence_corners_m):
            raise ValueError("fence_corners_m is an outline that crosses itself; write the corners in order around it")
        if self.fence_corners_m and not is_inside(self.fence_corners_m, 0.0, 0.0):
            raise ValueError("fence_corners_m leaves home outside, from which they count; write corners around 0, 0")
        return self


class SafetyParameters(Section):
    """When the drone slows down, hovers, hands over to the autopilot and falls silent."""

    gate: GateParameters = GateParameters()
    camera_timeout_periods: Annotated[float, Field(gt=0, le=100)] = services.FRAME.timeout
    """A camera without a usable frame for this many of its frame periods is lost."""
    max_lost_cameras: Annotated[int, Field(ge=0)] = 1
    """Fly on with the others, degraded, while no more than this many are lost; at least one has to see."""
    max_dropped_share: Share = 0.2
    """Degraded when a larger share of the latest frames was dropped."""
    estimate_timeout_s: Annotated[float, Field(gt=0, le=60)] = services.ESTIMATE.timeout
    """Hover when the pilot's newest output is older; allow three steps. At most `gate.command_timeout_s`."""
    degraded_ego_motion_s: Annotated[float, Field(gt=0, le=600)] = 0.75
    """Degraded when no step has found the own motion for this long: at two steps a second, two in a row."""
    max_ego_motion_s: Annotated[float, Field(gt=0, le=600)] = 2.75
    """Hover when no step has found it for this long."""
    degraded_load: Positive = 1.0
    """Degraded when the duration of the steps (95th percentile) over the permitted one is above this."""
    max_load: Positive = 2.0
    """Hover when it is above this."""
    degraded_temperature_c: float = 85.0
    """Degraded from this temperature of the hottest thermal zone on."""
    max_temperature_c: float = 95.0
    """Hover from this temperature on."""
    max_loop_lag_s: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Degraded when the event loop lags by more."""
    degraded_velocity_error_m_s: Positive = consistency.RESPONSE_DEGRADED.limit
    """Degraded when the drone's velocity deviates from its setpoints by more (root mean square over ten seconds)."""
    max_velocity_error_m_s: Positive = consistency.RESPONSE.limit
    """Hold is requested when it deviates by more than this."""
    hold_room_m: Annotated[float, Field(ge=0, le=100)] = 2.0
    """Hold knows of no obstacles. So it is then requested where none is nearer than this to the drone's middle; until
    then, for 30 s at most, the drone flies on, degraded."""
    heartbeat_timeout_s: Annotated[float, Field(gt=0, le=10)] = services.HEARTBEAT.timeout
    """The link to the autopilot counts as lost without a heartbeat for this long, and flockd falls silent for good; two
    of them may be lost while other messages arrive."""
    link_timeout_s: Annotated[float, Field(gt=0, le=10)] = services.AUTOPILOT.timeout
    """The same, without any message of the autopilot."""
    neighbours_timeout_s: Annotated[float, Field(gt=0, le=60)] = services.NEIGHBOUR.timeout
    """No confirmed neighbour seen for this long: the drone is alone."""
    alone_s: Duration | None = 10.0
    """How long it flies on alone before it asks for Hold. null: for ever."""
    outside_s: Annotated[float, Field(gt=0, le=60)] = 3.0
    """How long it may take to come back into the fence and the heights before it asks for Hold."""
    on_battery_low: AutopilotMode = "hold"
    """What flockd requests from the autopilot when that reports a low battery."""
    on_position_lost: AutopilotMode = "hold"
    """What flockd requests from the autopilot when that has lost its position; the autopilot acts by itself too."""
    hover_s: Annotated[float, Field(gt=0, le=3)] = 1.0
    """The longest hover, before Hold is asked for."""
    recovery_s: Annotated[float, Field(ge=0, le=600)] = 2.0
    """How long a degraded drone has to be without a fault before it flies as usual again."""
    ask_timeout_s: Annotated[float, Field(gt=0, le=5)] = 2.0
    """How long the autopilot has to leave offboard on request, before flockd falls silent."""
    first_flight_layer: Annotated[int, Field(ge=1, le=100)] | None = None
    """For first flights: the drone's number in its flock, another for each. A real drone then flies at 1 m/s at most,
    and at 3 m above the ground at home and 4 m more for each number after 1, whatever its mission says. null: off.
    Simulated flights ignore it."""

    @model_validator(mode="after")
    def _worse_comes_later(self) -> Self:
        for limit in ("ego_motion_s", "load", "temperature_c", "velocity_error_m_s"):
            if getattr(self, f"degraded_{limit}") > getattr(self, f"max_{limit}"):
                raise ValueError(f"degraded_{limit} is above max_{limit}; write a smaller one")
        if self.estimate_timeout_s > (silent_s := self.gate.command_timeout_s):
            told = f"is above gate.command_timeout_s {silent_s:g}, after which the gate sends nothing, not even a hover"
            raise ValueError(f"estimate_timeout_s {told}; write a smaller one, or a larger one there")
        return self

    @model_validator(mode="after")
    def _the_layer_can_be_flown(self) -> Self:
        layer, gate = self.first_flight_layer, self.gate
        if layer is None:
            return self
        height_m, fault = layer_height_m(layer), ""
        if not gate.min_height_m <= height_m <= gate.max_height_m:
            band = f"{gate.min_height_m:g} to {gate.max_height_m:g} m"
            fault = f"leads to a height of {height_m:g} m, and safety.gate allows {band}; correct one of them"
        elif gate.vertical_separation_m >= LAYERS_APART_M:
            fault = (
                f"puts drones {LAYERS_APART_M:g} m above each other, and gate.vertical_separation_m is not below that; "
                "write a smaller one there"
            )
        refuse(self, {("first_flight_layer",): fault} if fault else {})
        return self


def layer_height_m(layer: int) -> float:
    """Height above the ground at home of a layer of first flights, counted from 1."""
    return LOWEST_LAYER_M + (layer - 1) * LAYERS_APART_M
