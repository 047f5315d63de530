"""The flocking law, Eq. 38-42."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from flockd.core.config.base import Distance, Duration, NonNegative, Section


class WeightParameters(Section):
    """The influence weight W of Eq. 39 and 40."""

    kind: Literal["uniform", "nearest"] = "nearest"
    """`nearest`: 1 for the nearest neighbours, 0 for others. `uniform`: 1 for all; above ten drones flocks contract."""
    nearest: Annotated[int, Field(ge=1)] = 6
    """For kind `nearest`: the number of neighbours. In flocks of up to seven drones, 6 equals `uniform`."""


class FlockingParameters(Section):
    """Eq. 38-42, with the paper's values."""

    cohesion: NonNegative = 0.1
    """C_f"""
    alignment: NonNegative = 0.1
    """C_av"""
    separation: NonNegative = 10.0
    """C_c"""
    velocity: NonNegative = 1.0
    """C_vf"""
    observation_distance_m: Distance = 20.0
    """D_c"""
    desired_distance_m: Distance = 3.5
    """D_d"""
    separation_distance_m: Distance = 1.5
    """D_II"""
    weight: WeightParameters = WeightParameters()
    cohesion_time_s: Duration | None = 5.0
    """Time after which a neighbour may attract with `max_acceleration_m_s2`. Before that the limit grows with the
    square of the time for which it has been seen. Most false neighbours last for a few seconds and are far away, where
    Eq. 39 attracts most. null: no limit, as in the paper. docs/concepts/flocking_law.md explains it."""
    size: Literal["off", "learn"] = "off"
    """`learn`: the drone estimates in flight the size of the others, the same for all, if the networks do not know it.
    It moves up and down by 0.3 m for twelve seconds. The shift of the others' bearings gives their ranges and so their
    size, which is used for all later ranges. If you know the size, write `perception.drone_size_m` instead."""
    own_weight: NonNegative = 1.0
    """W_i of Eq. 42"""
    max_speed_m_s: Annotated[float, Field(gt=0, le=50)] = 3.0
    max_acceleration_m_s2: Annotated[float, Field(gt=0, le=50)] = 2.0
