"""The table of all checks of one sensor against another: the values compared, the limit, and the reaction.

They work like the innovation checks of a Kalman filter: a value of one source is compared with its expectation from the
others, and is not used beyond the limit. Configuration keys take their defaults from here, code its other limits. Times
and ages of messages are in `services`.
"""

from __future__ import annotations

from typing import NamedTuple


class Check(NamedTuple):
    """One check, as one of its users makes it."""

    compared: str
    """What, with what."""
    limit: float
    """In `unit`."""
    unit: str
    """`SD`: standard deviations of what is expected."""
    reaction: str
    """Reaction beyond the limit: an event of the supervisor, whose table gives the reaction, or a text."""
    source: str
    """Source of the limit."""
    keys: tuple[str, ...] = ()
    """Configuration keys whose default `limit` is."""


RANGE_GROUND = Check(
    "range to the ground, with the ground expected from the ranges before and the own motion",
    4.0,
    "SD",
    "it is not used; the next one like it is, unless the barometer contradicts it",
    "PX4's EKF2_RNG_GATE 5 SD",
    ("perception.range_finder.gate_sigma",),
)
RANGE_BAROMETER = Check(
    "height of the ground by range finder and barometer, with the bounds that the ranges before leave it",
    1.0,
    "m",
    "after more than one such range the range finder is not used, and the scale is the barometer's",
    "steps of the ground, and a barometer's drift in 15 s; PX4's EKF2_RNG_K_GATE 0.5 SD needs level ground",
    ("perception.range_finder.tolerance_m",),
)
RANGE_SLOPE = Check(
    "how far these bounds move apart, for each metre flown",
    0.25,
    "m/m",
    "as for the one above",
    "hills of 15 % with bumps; PX4's EKF2_TERR_GRAD 0.5",
    ("perception.range_finder.max_slope",),
)
RANGE_REPEATED = Check(
    "change of the barometer's height, while all ranges are the same to the last bit",
    0.5,
    "m",
    "the range finder is not used until it gives another range, which agrees",
    "PX4's range_stuck_threshold 0.1 m; more, as a range in whole centimetres may repeat along a slope",
)
RANGE_VISION = Check(
    "way flown by the images, whose scale is the range, with the way by the autopilot, in fading sums",
    3.0,
    "SD",
    "the range finder is not used where the barometer's height fits better",
    "PX4's EKF2_EVV_GATE 3 SD; its velocity wanders by 0.15 m/s for seconds (measured in its simulator)",
)
EGO_MOTION = Check(
    "velocity by the images, with the autopilot's velocity minus its known error",
    5.0,
    "SD",
    "the ego-motion is refused, and sigma grows until one that shows the same is accepted",
    "PX4's EKF2_GPS_V_GATE 5 SD",
)
STAMP = Check(
    "time of a message by its stamp and TIMESYNC's clock, with its arrival: between 0 and the shortest round trip",
    0.005,
    "s",
    "messages count from when they arrive; after 1.5 s an event",
    "in this time a turn of 60 degrees a second turns by 0.3 degrees",
)
RESPONSE_DEGRADED = Check(
    "velocity flown, with the one commanded (root mean square over ten seconds)",
    0.6,
    "m/s",
    "velocity_off",
    "config/campaigns/gusts.yaml: where no two drones touch",
    ("safety.degraded_velocity_error_m_s",),
)
RESPONSE = Check(
    "the same",
    0.8,
    "m/s",
    "velocity_far_off",
    "likewise",
    ("safety.max_velocity_error_m_s",),
)

CHECKS = tuple(one for one in list(globals().values()) if isinstance(one, Check))
"""All of them, in this order."""
