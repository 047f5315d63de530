"""The range finder: there, faces down, often enough, and for the heights that are flown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from flockd.core.config import DroneConfig
from flockd.core.messages import RangeReading
from flockd.ground.doctor.finding import Finding, failed, passed, warned
from flockd.onboard.autopilot.mavlink_messages import FACES_DOWN

ABOUT = "range finder"
WATCHED_S = 1.5
"""How long its messages are watched."""
LEAST_RATE_HZ = 10.0
NEAREST_M = 0.5
"""A sensor that measures nothing nearer is blind at take-off and landing."""
_FACES = {0: "forward", 2: "to the right", 4: "backward", 6: "to the left", 24: "up"}


def judge_range_finder(
    reading: RangeReading | None, arrivals_s: Mapping[int, Sequence[float]], config: DroneConfig
) -> list[Finding]:
    """Findings of a drone that is on the ground; none where the configuration takes the height from elsewhere.

    Args:
        reading: the newest of the sensor that faces down, or the autopilot's own distance to bottom.
        arrivals_s: when the last DISTANCE_SENSOR messages came, by MAV_SENSOR_ORIENTATION.
        config: the drone's.
    """
    perception = config.perception
    if perception.scale != "height" or perception.height == "barometer":
        return []
    blame = failed if perception.height == "range_finder" else warned
    if reading is None:
        if arrivals_s:
            others = ", ".join(_FACES.get(number, f"by MAV_SENSOR_ORIENTATION {number}") for number in arrivals_s)
            fix = "mount it facing down, and set its orientation in PX4 (such as SENS_CM8JL65_R_0) to 25, downward"
            return [blame(ABOUT, f"no range finder faces down; those that are heard face {others}", fix)]
        fix = "see to the sensor and its driver in PX4, or write perception.height: barometer"
        return [blame(ABOUT, "the autopilot sends no DISTANCE_SENSOR and no distance to bottom", fix)]
    if reading.vertical:
        measured = f"no DISTANCE_SENSOR; PX4's own distance to bottom is {reading.range_m:.2f} m"
        return [warned(ABOUT, measured, "let PX4 send DISTANCE_SENSOR on this link: it is newer, and has its limits")]
    return [_judge_sensor(reading, arrivals_s.get(FACES_DOWN, ()), config)]


def _judge_sensor(reading: RangeReading, arrivals_s: Sequence[float], config: DroneConfig) -> Finding:
    least_m, most_m = reading.min_m or 0.0, reading.max_m
    limits = f"from {least_m:.2f} m" if most_m is None else f"from {least_m:.2f} to {most_m:.1f} m"
    rate_hz = _rate_hz(arrivals_s)
    measured = f"faces down, {reading.range_m:.2f} m now, measures {limits}, {rate_hz:.0f} times a second"
    gate = config.safety.gate
    if most_m is not None and most_m < gate.max_height_m:
        fix = f"make safety.gate.max_height_m {most_m:.0f} m or less, or take a sensor that measures farther"
        return warned(ABOUT, f"{measured}; the drone may fly at {gate.max_height_m:g} m", fix)
    if least_m > NEAREST_M:
        return warned(ABOUT, measured, "take a sensor that measures nearer, or fly higher than that from the start")
    if rate_hz < LEAST_RATE_HZ:
        return warned(ABOUT, measured, f"let the sensor and this link give it at {LEAST_RATE_HZ:g} Hz or more")
    return passed(ABOUT, measured)


def _rate_hz(arrivals_s: Sequence[float]) -> float:
    if len(arrivals_s) < 2 or arrivals_s[-1] <= arrivals_s[0]:
        return 0.0
    return (len(arrivals_s) - 1) / (arrivals_s[-1] - arrivals_s[0])
