"""The supervisor's inputs, and the events detected in them: faults, and other reasons to end a flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from flockd.core import services
from flockd.core.config.safety import SafetyParameters

OFFBOARD = "offboard"
"""The flight mode in which the autopilot follows setpoints; the pilot or the autopilot itself flies in all others."""


@dataclass(frozen=True)
class CameraHealth:
    """State of one camera."""

    age_s: float
    """Age of its newest usable frame; infinite before the first."""
    period_s: float
    """Expected time between its frames."""
    fault: str | None
    """`unplugged`: its device reported an error or is gone, and is not open again yet. `frozen`: it keeps sending the
    same image or the same sequence number. `noisy`: its images have been noise for too long. None: none of these."""


@dataclass(frozen=True)
class Inputs:
    """All inputs of the supervisor, at one instant. NaN counts as a fault."""

    cameras: Mapping[str, CameraHealth]
    """Every camera of the rig, by name."""
    dropped_share: float
    """Share of the frames of the last seconds that were corrupt, truncated, stamped out of order, or noise."""
    estimate_age_s: float
    """Age of the pilot's newest output; infinite before the first."""
    ego_motion_age_s: float
    """Time since a step of the pilot last found the drone's own motion."""
    network_faults: int
    """Outputs of a network that are NaN, infinite or out of range, since the last call."""
    inference_stuck: bool
    """A network has passed its deadline and not returned yet."""
    load: float
    """95th percentile of the steps' durations over the permitted one, of the slowest stage."""
    temperature_c: float | None
    """Temperature of the hottest thermal zone; None: the computer has none."""
    loop_lag_s: float
    """Lag of the event loop."""
    velocity_error_m_s: float
    """Root mean square of the velocity's deviation from its setpoints in the last seconds."""
    velocity_late_s: float
    """Additional delay, beyond the expected one, with which the velocity follows them."""
    dead_tasks: tuple[str, ...]
    """Names of tasks that have ended unexpectedly."""
    neighbours_age_s: float
    """Time since a neighbour was last seen, confirmed or not yet; infinite before the first."""
    nearest_neighbour_m: float
    """Range of the nearest confirmed neighbour; infinite without one."""
    refused_commands: int
    """Commands since the last call that the gate refused as not finite or too large."""
    obstacle_near: bool
    """Whether an obstacle is nearer than `hold_room_m`."""
    outside_fence: bool
    """As of the function `outside_fence`."""
    outside_heights: bool
    """As of the function `outside_heights`."""
    motion_age_s: float
    """Age of the autopilot's newest position and velocity; infinite before the first."""
    heartbeat_age_s: float
    """Age of the autopilot's newest heartbeat; infinite before the first."""
    message_age_s: float
    """Age of its newest message of any kind."""
    stream_fault: str | None
    """Why the streamer has ended offboard flight by itself, until the supervisor has silenced it; None: it has not."""
    autopilot_failsafe: bool
    """Whether the autopilot flies its own failsafe instead of what it was commanded."""
    foreign_setpoints: str | None
    """The evidence of another sender's setpoints; None: there is none."""
    parameter_fault: str | None
    """The fault of an autopilot's parameter, before the flight or since; None: there is none."""
    frame_jumped: bool
    """Whether the autopilot's local frame or heading has jumped far in this flight."""
    flight_mode: str | None
    """The autopilot's: `OFFBOARD` or any other word. None: not known yet, as for the next two."""
    armed: bool | None
    in_air: bool | None
    battery_low: bool
    """Reported by the autopilot."""
    position_lost: bool
    """Whether the autopilot has lost its estimate, or the satellites that it needs for it."""
    shutdown_asked: bool
    """Whether the process was asked to end."""
    hold_asked: bool
    """Whether an operator asked for it; `land_asked` likewise."""
    land_asked: bool
    resume_asked: bool
    """Whether an operator asked, since the last call, to be ready again after a flight that ended in the air."""
    takeover: str | None = None
    """As of `MissionStatus`."""


class Event(StrEnum):
    """A fault or another reason to react. The value is its name in telemetry."""

    SIGHT_LOST = "sight_lost"
    CAMERA_LOST = "camera_lost"
    FRAMES_DROPPED = "frames_dropped"
    ESTIMATE_STALE = "estimate_stale"
    EGO_MOTION_POOR = "ego_motion_poor"
    EGO_MOTION_LOST = "ego_motion_lost"
    NETWORK_FAULT = "network_fault"
    INFERENCE_STUCK = "inference_stuck"
    OVERLOADED = "overloaded"
    FAR_OVERLOADED = "far_overloaded"
    HOT = "hot"
    TOO_HOT = "too_hot"
    LOOP_LATE = "loop_late"
    VELOCITY_OFF = "velocity_off"
    VELOCITY_FAR_OFF = "velocity_far_off"
    NO_ROOM_TO_HOLD = "no_room_to_hold"
    TASK_DIED = "task_died"
    NEIGHBOURS_LOST = "neighbours_lost"
    NEIGHBOUR_CLOSE = "neighbour_close"
    COMMAND_REFUSED = "command_refused"
    FENCE_LEFT = "fence_left"
    HEIGHTS_LEFT = "heights_left"
    MOTION_UNKNOWN = "motion_unknown"
    LINK_LOST = "link_lost"
    STREAM_ENDED = "stream_ended"
    AUTOPILOT_FAILSAFE = "autopilot_failsafe"
    FOREIGN_SETPOINTS = "foreign_setpoints"
    PARAMETERS_UNSUITABLE = "parameters_unsuitable"
    FRAME_JUMPED = "frame_jumped"
    NOT_OFFBOARD = "not_offboard"
    NOT_ARMED = "not_armed"
    NOT_IN_AIR = "not_in_air"
    BATTERY_LOW = "battery_low"
    POSITION_LOST = "position_lost"
    SHUTDOWN_ASKED = "shutdown_asked"
    HOLD_ASKED = "hold_asked"
    LAND_ASKED = "land_asked"
    MISSION_LANDS = "mission_lands"
    MISSION_RETURNS = "mission_returns"
    # From the supervisor itself, not from its inputs:
    STARTED = "started"
    NO_ANSWER = "no_answer"


def link_lost(heartbeat_age_s: float, message_age_s: float, p: SafetyParameters) -> str | None:
    """Why the link to the autopilot counts as lost, by the ages of its newest heartbeat and message; None: it does not.

    Used by the supervisor and by the streamer.
    """
    if not message_age_s <= p.link_timeout_s:
        return f"no message from the autopilot {_since(message_age_s)}"
    if not heartbeat_age_s <= p.heartbeat_timeout_s:
        return f"no heartbeat from the autopilot {_since(heartbeat_age_s)}"
    return None


def notice(inputs: Inputs, p: SafetyParameters) -> dict[Event, str]:
    """The events present in the inputs, each with one short sentence for people; empty in a flight without faults."""
    fresh = {name for name, one in inputs.cameras.items() if one.age_s <= p.camera_timeout_periods * one.period_s}
    lost = [f"{name} {one.fault or 'silent'}" for name, one in inputs.cameras.items() if one.fault or name not in fresh]
    sightless = len(lost) == len(inputs.cameras) or len(lost) > p.max_lost_cameras
    lost_link = link_lost(inputs.heartbeat_age_s, inputs.message_age_s, p)
    # While another sender's setpoints are followed, the own ones are not.
    far_off = not (
        inputs.velocity_error_m_s <= p.max_velocity_error_m_s and inputs.velocity_late_s <= p.gate.reaction_s
    )
    is_off = inputs.velocity_error_m_s > p.degraded_velocity_error_m_s or inputs.velocity_late_s > 0
    too_far_off = far_off and inputs.foreign_setpoints is None
    off = f"the velocity differs from its setpoints by {inputs.velocity_error_m_s:.1f} m/s"
    if inputs.velocity_late_s > 0:
        off = f"{off}, and follows them {inputs.velocity_late_s:.1f} s later than expected"
    most = f"limits: {p.max_velocity_error_m_s:g} m/s, {p.gate.reaction_s:g} s"
    cause = f"{off} ({most}): wind, or an autopilot that does not follow"
    room = f"the drone flies on to where no obstacle is within {p.hold_room_m:g} m, and asks for Hold there"
    ego_motion = {Event.EGO_MOTION_POOR: p.degraded_ego_motion_s, Event.EGO_MOTION_LOST: p.max_ego_motion_s}
    load = {Event.OVERLOADED: p.degraded_load, Event.FAR_OVERLOADED: p.max_load}
    heat = {Event.HOT: p.degraded_temperature_c, Event.TOO_HOT: p.max_temperature_c}
    temperature_c = -math.inf if inputs.temperature_c is None else inputs.temperature_c
    motion, ended = "no position and velocity from the autopilot", f"setpoints ended: {inputs.stream_fault}"
    close = f"a neighbour is {inputs.nearest_neighbour_m:.1f} m away"
    table = (
        (Event.SIGHT_LOST, sightless, f"too few cameras deliver images: {', '.join(lost) or 'there are none'}"),
        (Event.CAMERA_LOST, len(lost) > 0 and not sightless, f"a camera is lost: {', '.join(lost)}"),
        *_beyond(
            {Event.FRAMES_DROPPED: p.max_dropped_share}, inputs.dropped_share, "{:.0%} of the frames were dropped"
        ),
        *_older({Event.ESTIMATE_STALE: p.estimate_timeout_s}, inputs.estimate_age_s, "no output of the pilot"),
        *_older(ego_motion, inputs.ego_motion_age_s, "no ego-motion estimated"),
        (Event.NETWORK_FAULT, inputs.network_faults > 0, "a network's output is not finite or not plausible"),
        (Event.INFERENCE_STUCK, inputs.inference_stuck, "a network does not respond"),
        *_beyond(load, inputs.load, "a step takes {:.0%} of the step time"),
        *_beyond(heat, temperature_c, "the computer is at {} °C"),
        *_beyond({Event.LOOP_LATE: p.max_loop_lag_s}, inputs.loop_lag_s, "the event loop is {:.2f} s late"),
        (Event.FOREIGN_SETPOINTS, inputs.foreign_setpoints is not None, f"{inputs.foreign_setpoints}"),
        (Event.PARAMETERS_UNSUITABLE, inputs.parameter_fault is not None, f"{inputs.parameter_fault}"),
        (Event.FRAME_JUMPED, inputs.frame_jumped, "the autopilot's estimate of position or heading has jumped"),
        (Event.VELOCITY_OFF, is_off and not far_off, off),
        (Event.VELOCITY_FAR_OFF, too_far_off and not inputs.obstacle_near, cause),
        (Event.NO_ROOM_TO_HOLD, too_far_off and inputs.obstacle_near, f"{cause}; {room}"),
        (Event.TASK_DIED, len(inputs.dead_tasks) > 0, f"a task stopped unexpectedly: {', '.join(inputs.dead_tasks)}"),
        *_older({Event.NEIGHBOURS_LOST: p.neighbours_timeout_s}, inputs.neighbours_age_s, "no neighbour seen"),
        (Event.NEIGHBOUR_CLOSE, not inputs.nearest_neighbour_m >= p.gate.min_separation_m, close),
        (Event.COMMAND_REFUSED, inputs.refused_commands > 0, "a command was not finite or far too large"),
        (Event.FENCE_LEFT, inputs.outside_fence, "outside the fence"),
        (Event.HEIGHTS_LEFT, inputs.outside_heights, "outside the permitted heights"),
        (Event.LINK_LOST, lost_link is not None, f"{lost_link}"),
        *_older({Event.MOTION_UNKNOWN: services.MOTION.timeout}, inputs.motion_age_s, motion),
        (Event.STREAM_ENDED, lost_link is None and inputs.stream_fault is not None, ended),
        (Event.AUTOPILOT_FAILSAFE, inputs.autopilot_failsafe, _FAILSAFE),
        (Event.NOT_OFFBOARD, inputs.flight_mode != OFFBOARD, f"the flight mode is {inputs.flight_mode or 'not known'}"),
        (Event.NOT_ARMED, not inputs.armed, "not armed"),
        (Event.NOT_IN_AIR, not inputs.in_air, "not in the air"),
        (Event.BATTERY_LOW, inputs.battery_low, "the autopilot reports a low battery"),
        (Event.POSITION_LOST, inputs.position_lost, "the autopilot has lost its position"),
        (Event.SHUTDOWN_ASKED, inputs.shutdown_asked, "flockd was asked to end"),
        (Event.HOLD_ASKED, inputs.hold_asked, "an operator asked for Hold"),
        (Event.LAND_ASKED, inputs.land_asked, "an operator asked for Land"),
        (Event.MISSION_LANDS, inputs.takeover == "land", "the mission is over and ends with Land"),
        (Event.MISSION_RETURNS, inputs.takeover == "return", "the mission is over and ends with Return"),
    )
    return {event: sentence for event, holds, sentence in table if holds}


_FAILSAFE = (
    "the autopilot is in its failsafe and would follow any setpoint; select Hold or Position, then offboard once "
    "flockd is ready"
)


def _beyond(limits: Mapping[Event, float], value: float, sentence: str) -> list[tuple[Event, bool, str]]:
    """The event of the last limit that a number exceeds, as a row of the table; its sentence names the number."""
    return [(event, True, sentence.format(value)) for event, limit in limits.items() if not value <= limit][-1:]


def _older(limits: Mapping[Event, float], age_s: float, sentence: str) -> list[tuple[Event, bool, str]]:
    return _beyond(limits, age_s, f"{sentence} {_since(age_s)}")


def _since(age_s: float) -> str:
    return "yet" if age_s == math.inf else f"for {age_s:.1f} s"
