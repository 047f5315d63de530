"""What the doctor makes of a range finder, and of one that is not there or looks elsewhere."""

from __future__ import annotations

import pytest

from flockd.core.choices import HeightSource
from flockd.core.config import DroneConfig, load_drone
from flockd.core.data import data_path
from flockd.core.messages import RangeReading
from flockd.ground.doctor import Level
from flockd.ground.doctor.autopilot_checks import judge_range_finder

AT_30_HZ = {25: tuple(k / 30.0 for k in range(46))}
GOOD = RangeReading(1.5, 0.12, min_m=0.15, max_m=20.0, quality=1.0)


def _config(height: HeightSource) -> DroneConfig:
    drone = load_drone(data_path("config") / "quadrotor.yaml")
    return drone.model_copy(update={"perception": drone.perception.model_copy(update={"height": height})})


def test_one_that_faces_down_passes_and_its_limits_and_rate_are_told() -> None:
    (found,) = judge_range_finder(GOOD, AT_30_HZ, _config("best"))
    assert found.level is Level.PASS
    assert found.measured == "faces down, 0.12 m now, measures from 0.15 to 20.0 m, 30 times a second"


@pytest.mark.parametrize(("height", "level"), [("range_finder", Level.FAILURE), ("best", Level.WARNING)])
def test_none_is_a_failure_where_nothing_else_gives_the_scale(height: HeightSource, level: Level) -> None:
    (absent,) = judge_range_finder(None, {}, _config(height))
    (forward,) = judge_range_finder(None, {0: (1.0,)}, _config(height))
    assert absent.level is forward.level is level
    assert "those that are heard face forward" in forward.measured


def test_a_drone_that_flies_by_its_barometer_is_not_asked() -> None:
    assert judge_range_finder(None, {}, _config("barometer")) == []


@pytest.mark.parametrize(
    ("reading", "arrivals", "why"),
    [
        (RangeReading(1.5, 1.0, min_m=0.15, max_m=8.0), AT_30_HZ, "the drone may fly at 10 m"),
        (RangeReading(1.5, 1.0, min_m=0.8, max_m=20.0), AT_30_HZ, "measures from 0.80"),
        (GOOD, {25: (0.0, 0.2, 0.4)}, "5 times a second"),
        (RangeReading(1.5, 1.0, vertical=True), {}, "PX4's own distance to bottom"),
    ],
)
def test_what_limits_it_is_a_warning(reading: RangeReading, arrivals: dict[int, tuple[float, ...]], why: str) -> None:
    (found,) = judge_range_finder(reading, arrivals, _config("best"))
    assert found.level is Level.WARNING
    assert why in found.measured
