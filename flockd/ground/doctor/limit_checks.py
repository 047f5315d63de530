"""How fast and how high the drone is to fly: first flights, and the envelope that was proven."""

from __future__ import annotations

from collections.abc import Iterator

from flockd.core.config import DroneConfig
from flockd.core.config.document import key_text
from flockd.core.config.real_drone import beyond_envelope
from flockd.ground.doctor.finding import Finding, passed, warned


def check_limits(config: DroneConfig) -> Iterator[Finding]:
    """``config`` as it is flown."""
    speed = f"{config.flocking.max_speed_m_s:g} m/s at most"
    layer = config.safety.first_flight_layer
    if layer is None:
        yield passed("first flight", f"off: {speed}")
    else:
        yield passed(
            "first flight", f"on: layer {layer}, {config.mission.height_m:g} m above the ground at home, {speed}"
        )
    for key, text in beyond_envelope(config).items():
        measured, _, fix = text.partition("; ")
        yield warned(key_text(key), measured, fix)
