"""How fast real drones may fly: the envelope in which they were shown to keep apart."""

from __future__ import annotations

from collections.abc import Mapping

from flockd.core.config.document import KeyPath, Place
from flockd.core.config.drone import DroneConfig
from flockd.core.config.first_flight import as_flown
from flockd.core.errors import ConfigProblem

PROVEN_M_S: Mapping[KeyPath, float] = {("flocking", "max_speed_m_s"): 3.0, ("safety", "gate", "max_speed_m_s"): 4.0}
"""The highest proven speed, by key: what a drone asks for, over ground, and what its gate lets through, corrections for
wind and for the autopilot's own error included. No mission or order is faster than the first.

Source: `tests/sim/test_encounters.py`. Drones that meet head-on keep at least 1 m, each with these two limits, 5 % of
range error, 5 % of detections missed, a step every 0.5 s, detections from 20 m on; 12 seeds at each speed up to 3 m/s.
"""


def beyond_envelope(config: DroneConfig) -> dict[KeyPath, str]:
    """What of a drone's speeds is outside the envelope, by key; nothing for one without an autopilot."""
    if config.autopilot is None:
        return {}
    flown: Mapping[KeyPath, float] = {
        ("flocking", "max_speed_m_s"): config.flocking.max_speed_m_s,
        ("safety", "gate", "max_speed_m_s"): config.safety.gate.max_speed_m_s,
    }
    return {
        key: f"{flown[key]:g} m/s is above the {most:g} m/s up to which drones were shown to keep apart; "
        f"write {most:g} or less, or go beyond it with --force"
        for key, most in PROVEN_M_S.items()
        if flown[key] > most
    }


def outside_envelope(config: DroneConfig, places: Mapping[KeyPath, Place]) -> list[ConfigProblem]:
    """The same of `config` as it is flown, as problems; `places` has every value that is no default."""
    return [places[key].problem(text) for key, text in beyond_envelope(as_flown(config)).items()]
