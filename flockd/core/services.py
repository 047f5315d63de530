"""The table of all messages whose age matters: rate, time-out, and the reaction to an older message.

Configuration keys take their defaults from here, code its other limits. After openpilot's `cereal/services.py`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple


class Service(NamedTuple):
    """One message, as one of its readers expects it."""

    message: str
    rate_hz: float
    """Expected rate with the configuration's defaults."""
    timeout: float
    """In `unit`."""
    reaction: str
    """Reaction to an older or missing message: an event, whose reaction is in the supervisor's table, or a text."""
    keys: tuple[str, ...] = ()
    """Configuration keys whose default `timeout` is."""
    unit: Literal["s", "periods"] = "s"

    @property
    def period_s(self) -> float:
        """Period at the expected rate."""
        return 1.0 / self.rate_hz


FRAME = Service("camera frame", 30.0, 3.0, "camera_lost", ("safety.camera_timeout_periods",), "periods")
FRAME_SILENCE = Service("camera frame", 30.0, 0.5, "the camera is closed and opened again", ("source.silence_s",))
FRAME_STAMP = Service("camera frame from a simulator", 30.0, 5.0, "the frame is dropped and counted")
ESTIMATE = Service("output of the pilot", 2.0, 1.5, "estimate_stale", ("safety.estimate_timeout_s",))
NEIGHBOUR = Service("confirmed neighbour", 2.0, 2.0, "neighbours_lost", ("safety.neighbours_timeout_s",))
WANTED = Service("`Wanted`", 2.0, 0.9, "the gate flies it ever slower", ("safety.gate.command_fresh_s",))
WANTED_GONE = Service("`Wanted`", 2.0, 1.5, "the gate sends nothing", ("safety.gate.command_timeout_s",))
PERMISSION = Service(
    "the supervisor's permission", 20.0, 0.3, "the gate sends nothing", ("safety.gate.permission_timeout_s",)
)
REQUEST = Service("`Request`", 20.0, 1.0, "the streamer sends nothing", ("autopilot.max_setpoint_age_s",))
CONTROL = Service("tick of the control loop", 20.0, 0.3, "the streamer sends nothing", ("autopilot.max_control_age_s",))
SETPOINT = Service("`Setpoint` in offboard flight", 20.0, 0.5, "the stream ends", ("autopilot.max_gap_s",))
SETPOINT_STREAM = Service("`Setpoint` before it", 20.0, 0.5, "offboard counts as refused for want of setpoints")
HEARTBEAT = Service(
    "the autopilot's heartbeat",
    1.0,
    3.5,  # two may be lost
    "link_lost",  # and the streamer's own end, on its thread, by the same judgement; so the next
    ("safety.heartbeat_timeout_s",),
)
AUTOPILOT = Service("any message of the autopilot", 50.0, 2.0, "link_lost", ("safety.link_timeout_s",))
POSITION_TARGET = Service("the autopilot's own setpoint", 10.0, 1.0, "it is compared with no setpoint")
OTHER_HEARTBEAT = Service("another computer's heartbeat", 1.0, 5.0, "it counts as gone")
VEHICLE_STATE = Service("the autopilot's state", 30.0, 2.0, "forgotten; frames of another time take the newest")
MOTION = Service("the autopilot's position and velocity", 30.0, 0.5, "motion_unknown")
GROUND_RANGE = Service("range to the ground", 30.0, 0.3, "it gives no scale", ("perception.range_finder.max_age_s",))
TIME_SYNC = Service("reply to a clock exchange", 5.0, 1.0, "it is not used")
STEP_TOPIC = Service("telemetry of a step", 2.0, 1.5, "watchers show nothing for it")
PREVIEW = Service("picture with detections", 2.0, 2.0, "the newest picture is shown without them")
ORDER = Service("an operator's order", 1.0, 5.0, "it is refused; its sender gives it again")
COMPUTER_TOPIC = Service("telemetry of the computer", 1.0, 3.0, "watchers show nothing for it")

SERVICES = tuple(one for one in list(globals().values()) if isinstance(one, Service))
"""All of them, in this order."""
