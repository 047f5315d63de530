"""Metadata of a flight: what was flown, with what, for how long."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Self

from pydantic import BaseModel, ConfigDict

from flockd.core.config import DroneConfig
from flockd.core.config.mission import MissionParameters

EXACT_STATES: Final = "truth"
"""`FlightMetadata.perception` of a flight whose drones were given the others' true states."""

_WITH_GOALS = ("waypoints", "operator")
"""Kinds of missions that lead to places."""

_FROZEN = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")


class FleetMetadata(BaseModel):
    """How a fleet of real daemons flew with the simulator."""

    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_inf_nan="constants")  # earlier ones had more

    speed_factor: float
    """How fast simulated time passed."""
    frame_sets: int
    """Rendered for each drone."""
    longest_step_s: float
    order_last_20s: float
    handed_over: dict[str, str]
    """Why a drone did not fly to the end, by its name."""
    mission_over: dict[str, str] = {}
    """When a drone's autopilot took over as its mission was over, by the drone's name."""
    modes: dict[str, list[str]] = {}
    """The flight modes of each autopilot, in order, by the drone's name."""
    exit_codes: dict[str, int]
    """Exit codes of the daemons, by the drone's name."""
    notes: list[str]


class HandedOver(BaseModel):
    """When and why a simulated drone's supervisor asked for Hold."""

    model_config = _FROZEN

    time_s: float
    reason: str


class LearnedSize(BaseModel):
    """The size of the others that a drone knew at the end of its flight, learned in flight."""

    model_config = _FROZEN

    since_s: float
    """Time of the flight at which it first knew a size."""
    size_m: float
    sigma: float
    """Relative standard deviation of `size_m`."""


class MissionMetadata(BaseModel):
    """Where the drones of a flight wanted to go."""

    model_config = _FROZEN

    kind: str
    """Kinds of the missions, by name, each once."""
    reached_m: float
    """How near to a goal the flock's middle, or the drone that leads it by hand, has to come."""
    led_by: int | None = None
    """The number from 0 of the drone whose goals these are, where only one that is flown by hand has any."""

    @classmethod
    def of(cls, flown: Sequence[tuple[MissionParameters, bool]]) -> Self:
        """The missions of all vehicles, each with whether it is flown by hand."""
        kinds = [f"{mission.kind}{' by hand' if by_hand else ''}" for mission, by_hand in flown]
        with_goals = [number for number, (mission, _) in enumerate(flown) if mission.kind in _WITH_GOALS]
        led_by = next((number for number in with_goals if all(flown[other][1] for other in with_goals)), None)
        reached_m = max(mission.reached_m for mission, _ in flown)
        return cls(kind=", ".join(dict.fromkeys(kinds)), reached_m=reached_m, led_by=led_by)


class FlightMetadata(BaseModel):
    """What was flown. A key that a flight log has no value for is left out of its file."""

    model_config = _FROZEN

    scenario: str
    """Its name; of a recording that names none, the drone's."""
    perception: str
    """`learned`, `learned, true flow` with roles replaced by the truth, or `EXACT_STATES`."""
    flow: str
    """Which network or method; `truth` or `none` where there was none."""
    scale: str
    """Where metric scale came from."""
    drones: int
    duration_s: float
    step_s: float
    circle_until_s: float
    desired_distance_m: float
    observation_distance_m: float
    separation_distance_m: float
    seed: int | None = None
    """Seed of the scenario; None where a recording does not hold it."""
    wall_s: float | None = None
    """How long the simulation took; None of a recording."""
    autopilot: str | None = None
    """What real daemons flew; None where there were no daemons."""
    fleet: FleetMetadata | None = None
    names: list[str] | None = None
    """Names of all drones, in the log's order; None where they are drone1, drone2, ..."""
    recorded: list[str] | None = None
    """Drones whose recordings the log was made of; None of a log that a simulator wrote."""
    began: str | None = None
    """Wall time, ISO 8601, at which the flight, or its first recording, was begun."""
    version: str | None = None
    """Version of flockd."""
    gated: bool | None = None
    """Whether simulated drones flew through their gates; None where that is not known."""
    slowed_share: float | None = None
    """Share of their time in which gates let drones fly otherwise than their pilots asked for; None: not known."""
    slowed_by: dict[str, float] = {}
    """The same by cause (as `flockd.sim.flock.control_loop.SlowedTime` names it); a moment may have several."""
    handed_over: dict[int, HandedOver] = {}
    """By the number of a simulated drone, from 0: when and why it did not fly on."""
    sizes: dict[int, LearnedSize] = {}
    """By the number of a drone that learned one, from 0."""
    interrupted: bool = False
    """It was ended before its time; `duration_s` is what was flown."""
    mission: MissionMetadata
    drone_radius_m: float | None = None
    """Radius of the sphere that holds a drone; None where there is nothing to collide with."""
    clock_at_start_s: float | None = None
    """Time of the recordings' clock at the log's 0 s."""

    @classmethod
    def of_configuration(cls, config: DroneConfig, **facts: Any) -> Self:
        """Metadata of a flight with this configuration of its drones. ``facts`` are all other fields, and override its
        own.

        Raises ValueError (pydantic's ValidationError) for facts that are missing, unknown or of another type.
        """
        configured = {
            "flow": config.perception.flow,
            "scale": config.perception.scale,
            "step_s": config.step_s,
            "circle_until_s": config.mission.circle_until_s if config.mission.kind == "circle_then_tangent" else 0.0,
            "mission": MissionMetadata(kind=config.mission.kind, reached_m=config.mission.reached_m),
            "desired_distance_m": config.flocking.desired_distance_m,
            "observation_distance_m": config.flocking.observation_distance_m,
            "separation_distance_m": config.flocking.separation_distance_m,
        }
        return cls.model_validate({**configured, **facts})

    @property
    def by_sight(self) -> bool:
        """Whether the drones found each other with their cameras."""
        return self.perception != EXACT_STATES
