"""The supervisor's limits, and those of the last gate before the autopilot."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core import consistency, services
from flockd.core.choices import AutopilotMode
from flockd.core.config.base import Duration, FromHome, Positive, Section, Share, refuse
from flockd.core.navigation import crosses_itself, is_inside

LOWEST_LAYER_M, LAYERS_APART_M = 3.0, 4.0
"""Distance of layers in first flights: `vertical_separation_m`, and a metre for errors of two drones' heights."""

Celsius = Annotated[float, Field(ge=0, le=125)]
"""No processor works hotter."""


class GateParameters(Section):
    """The last limits on setpoints, whatever code requests them."""

    permission_timeout_s: Annotated[float, Field(gt=0, le=0.4)] = services.PERMISSION.timeout
    """Validity of the supervisor's permission: half a second after flockd stalls it sends no setpoint."""
    command_fresh_s: Annotated[float, Field(gt=0, le=60)] = services.WANTED.timeout
    """A command older than this is flown more and more slowly. Allow for a step and its computation."""
    command_timeout_s: Annotated[float, Field(gt=0, le=60)] = services.WANTED_GONE.timeout
    """Age of a command at which the drone stands still. Allow for three steps of the pilot."""
    max_speed_m_s: Annotated[float, Field(gt=0, le=50)] = 4.0
    """A faster command counts as a fault and is refused."""
    max_acceleration_m_s2: Annotated[float, Field(gt=0, le=50)] = 5.0
    degraded_speed_m_s: Annotated[float, Field(gt=0, le=50)] = 1.0
    """The limit while the drone is degraded: a faster command is flown at this speed."""
    min_separation_m: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Distance to a neighbour below which no velocity towards it is allowed."""
    degraded_separation_m: Annotated[float, Field(ge=0, le=1000)] = 1.5
    """The same while the drone is degraded."""
    vertical_separation_m: Annotated[float, Field(ge=0, le=1000)] = 3.0
    """A neighbour less than this above or below counts as one at the drone's height. The drone does not climb or sink
    towards a neighbour whose horizontal distance is below 1.5 times `degraded_separation_m`, because the lower drone
    flies in the other's downwash."""
    max_climb_m_s: Annotated[float, Field(gt=0, le=20)] = 1.5
    """Largest rate of the height setpoint, up or down."""
    braking_m_s2: Annotated[float, Field(gt=0, le=20)] = 1.5
    """Braking that every drone of the flock can do: a drone flies towards a neighbour or an obstacle only so fast that
    it can stop in time."""
    obstacle_clearance_m: Annotated[float, Field(ge=0, le=100)] = 0.6
    """Distance of the drone's centre from an obstacle's surface below which no velocity towards it is allowed."""
    reaction_s: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Time from the detection of an obstacle until the drone brakes. It is also the time constant with which the
    drone's velocity is expected to follow its setpoints."""
    neighbour_reaction_s: Annotated[float, Field(ge=0, le=5)] = 1.0
    """Time from a neighbour's change of velocity until the drone brakes: the rest of the step, the computation of the
    next one, and the drone's response."""
    fence_radius_m: Annotated[float, Field(gt=0, le=100_000)] | None = 100.0
    """Radius of a circular fence around home. The drone brakes before it as before an obstacle; beyond it, it only
    flies inward. null: no circle."""
    fence_corners_m: tuple[tuple[FromHome, FromHome], ...] = ()
    """A fence of any shape: its corners in order, north and east of home. If a radius is given too, both hold."""
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
    """Limits at which the drone slows down, hovers, hands over to the autopilot or falls silent."""

    gate: GateParameters = GateParameters()
    camera_timeout_periods: Annotated[float, Field(gt=0, le=100)] = services.FRAME.timeout
    """A camera counts as lost after this many frame periods without a usable frame."""
    max_lost_cameras: Annotated[int, Field(ge=0)] = 1
    """Largest number of lost cameras with which the drone flies on, degraded; at least one camera must work."""
    max_dropped_share: Share = 0.2
    """Degraded if a larger share of the last frames was dropped."""
    estimate_timeout_s: Annotated[float, Field(gt=0, le=60)] = services.ESTIMATE.timeout
    """Hover if the pilot's newest output is older. Allow for three steps; at most `gate.command_timeout_s`."""
    degraded_ego_motion_s: Annotated[float, Field(gt=0, le=600)] = 0.75
    """Degraded if no step has found the own motion for this long: at two steps a second, after two without it."""
    max_ego_motion_s: Annotated[float, Field(gt=0, le=600)] = 2.75
    """Hover if no step has found it for this long."""
    degraded_load: Positive = 1.0
    """Degraded if the duration of steps (95th percentile) over the permitted duration is above this."""
    max_load: Positive = 2.0
    """Hover if it is above this."""
    degraded_temperature_c: Celsius = 85.0
    """Degraded from this temperature on, in the hottest thermal zone."""
    max_temperature_c: Celsius = 95.0
    """Hover from this temperature on."""
    max_loop_lag_s: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Degraded if the event loop lags by more."""
    degraded_velocity_error_m_s: Positive = consistency.RESPONSE_DEGRADED.limit
    """Degraded if the velocity deviates from its setpoints by more (root mean square over ten seconds)."""
    max_velocity_error_m_s: Positive = consistency.RESPONSE.limit
    """Hold is requested if it deviates by more than this."""
    hold_room_m: Annotated[float, Field(ge=0, le=100)] = 2.0
    """Hold ignores obstacles. So it is requested only if no obstacle is within this distance of the drone's centre.
    Until then, for 30 s at most, the drone flies on, degraded."""
    heartbeat_timeout_s: Annotated[float, Field(gt=0, le=10)] = services.HEARTBEAT.timeout
    """After this time without a heartbeat the link to the autopilot counts as lost, and flockd stays silent. Two
    heartbeats may be missing while other messages arrive."""
    link_timeout_s: Annotated[float, Field(gt=0, le=10)] = services.AUTOPILOT.timeout
    """The same without any message of the autopilot."""
    neighbours_timeout_s: Annotated[float, Field(gt=0, le=60)] = services.NEIGHBOUR.timeout
    """Time without a confirmed neighbour after which the drone counts as alone."""
    alone_s: Duration | None = 10.0
    """Time for which it flies on alone before it asks for Hold. null: no limit."""
    outside_s: Annotated[float, Field(gt=0, le=60)] = 3.0
    """Time for returning into the fence and the heights before it asks for Hold."""
    on_battery_low: AutopilotMode = "hold"
    """Mode that flockd requests if the autopilot reports a low battery."""
    on_position_lost: AutopilotMode = "hold"
    """Mode that flockd requests if the autopilot has lost its position; the autopilot also acts by itself."""
    hover_s: Annotated[float, Field(gt=0, le=3)] = 1.0
    """Longest hover before it asks for Hold."""
    recovery_s: Annotated[float, Field(ge=0, le=600)] = 2.0
    """Time without a fault after which a degraded drone flies normally again."""
    ask_timeout_s: Annotated[float, Field(gt=0, le=5)] = 2.0
    """Time for the autopilot to leave offboard on request, before flockd falls silent."""
    first_flight_layer: Annotated[int, Field(ge=1, le=100)] | None = None
    """For first flights: the drone's number in its flock, different for each. A real drone then flies at 1 m/s at most,
    in a layer 3 m above the ground at home for number 1 and 4 m higher for each further number, whatever its mission
    says. null: off. Simulated flights ignore it."""

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
    """Height above the ground at home, metres, of a layer of first flights, counted from 1."""
    return LOWEST_LAYER_M + (layer - 1) * LAYERS_APART_M
