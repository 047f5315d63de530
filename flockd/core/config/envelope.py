"""How fast real drones may fly: the envelope in which they were shown to keep apart."""

from __future__ import annotations

from collections.abc import Mapping

from flockd.core.config.document import KeyPath, Place
from flockd.core.config.drone import DroneConfig
from flockd.core.config.first_flight import as_flown
from flockd.core.errors import ConfigProblem

PROVEN_M_S: Mapping[KeyPath, float] = {("flocking", "max_speed_m_s"): 2.0, ("safety", "gate", "max_speed_m_s"): 4.0}
"""The highest proven speed, by key: what a drone asks for, over ground, and what its gate lets through, corrections for
wind and for the autopilot's own error included. No mission or order is faster than the first.

Source: what the shipped networks see. They know 98 % and more of the neighbours up to 8 m away, four of ten at 11.5 m
(`config/perceived/shipped_networks.yaml`), and head-on by sight drones keep 1 m at up to 2 m/s each
(`config/campaigns/head_on_by_sight.yaml`, docs/results.md). Where detections begin at 10 m and more, tracker and gate
keep drones apart at up to 3 m/s each (`config/campaigns/encounters.yaml`): that is the law's default, not this.
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
    return [_problem(key, text, places) for key, text in beyond_envelope(as_flown(config)).items()]


def _problem(key: KeyPath, text: str, places: Mapping[KeyPath, Place]) -> ConfigProblem:
    if key in places:
        return places[key].problem(text)
    file = next(iter(places.values())).file
    return ConfigProblem(file, 0, ".".join(map(str, key)), f"is not given, and its default of {text}")
