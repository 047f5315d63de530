"""The topic `/fleet`: one row a drone, for tables and plots."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypedDict

from flockd.fleet.page.drone_rows import Row


class FleetDroneMessage(TypedDict):
    """One drone; null where it does not tell, or told it too long ago."""

    drone: str
    """As in the topics."""
    fleet: str
    state: str
    """As in `flockd status`."""
    why: str
    """What is the matter, and what to do."""
    flight_mode: str | None
    armed: bool | None
    in_air: bool | None
    mission: str | None
    height_m: float | None
    north_m: float | None
    """From its home."""
    east_m: float | None
    speed_m_s: float | None
    yaw_deg: float | None
    neighbours: int | None
    """That it tracks."""
    battery_share: float | None
    load: float | None
    temperature_c: float | None
    rate_hz: float | None
    """Of its steps, as they arrive."""
    delay_ms: float | None
    """Of the link, there and back."""
    clock_s: float | None
    """Its wall clock less this computer's."""
    setpoints_missed: int | None
    messages_lost: int | None
    version: str | None


class FleetMessage(TypedDict):
    """All drones, in order of their names."""

    drones: list[FleetDroneMessage]


def fleet_message(rows: Mapping[str, Row], names: Mapping[str, str]) -> FleetMessage:
    """From the page's rows by key; ``names`` has the name in the topics of each key."""
    return FleetMessage(drones=[_drone(rows[key], names[key]) for key in by_name(rows, names)])


def by_name(keys: Iterable[str], names: Mapping[str, str]) -> list[str]:
    """The keys in order of their names, drone2 before drone10."""
    return sorted(keys, key=lambda key: (len(names[key]), names[key]))


def _drone(row: Row, name: str) -> FleetDroneMessage:
    north, east = row["position_ne"] or (None, None)
    return FleetDroneMessage(
        drone=name, fleet=row["fleet"], state=row["state"], why="; ".join(row["why"]), flight_mode=row["flight_mode"],
        armed=row["armed"], in_air=row["in_air"], mission=row["mission"], height_m=row["height_m"], north_m=north,
        east_m=east, speed_m_s=row["speed_m_s"], yaw_deg=row["yaw_deg"], neighbours=row["neighbours"],
        battery_share=row["battery_share"], load=row["load"], temperature_c=row["temperature_c"],
        rate_hz=row["rate_hz"], delay_ms=row["delay_ms"], clock_s=row["clock_s"],
        setpoints_missed=row["setpoints_missed"], messages_lost=row["messages_lost"], version=row["version"],
    )  # fmt: skip
