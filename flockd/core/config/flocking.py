"""The flocking law, Eq. 38-42."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from flockd.core.config.base import Distance, Duration, NonNegative, Section


class WeightParameters(Section):
    """The influence weight W of Eq. 39 and 40."""

    kind: Literal["uniform", "nearest"] = "nearest"
    """`nearest`: 1 on the nearest, 0 on the others; `uniform`: 1 on all, with which more than ten drones crowd."""
    nearest: Annotated[int, Field(ge=1)] = 6
    """With kind `nearest`: on how many. Seven drones or fewer fly with 6 as with `uniform`."""


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
    """After how long a neighbour may pull with `max_acceleration_m_s2`; until then with the square of the share of that
    time for which it has been seen. What is no drone is mostly seen for a few seconds, and far away, where Eq. 39 pulls
    most. null: no limit, as in the paper. docs/concepts/flocking_law.md says what it wins and costs."""
    size: Literal["off", "learn"] = "off"
    """`learn`: the drone finds out how large the others are, all alike, where nobody knows and the networks do not. For
    twelve seconds it moves up and down by 0.3 m, and the shift of the others' bearings tells their ranges without their
    size; ranges follow from that size from then on. Who knows it writes `perception.drone_size_m` instead."""
    own_weight: NonNegative = 1.0
    """W_i of Eq. 42"""
    max_speed_m_s: Annotated[float, Field(gt=0, le=50)] = 3.0
    max_acceleration_m_s2: Annotated[float, Field(gt=0, le=50)] = 2.0
