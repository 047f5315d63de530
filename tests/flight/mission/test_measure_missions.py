"""What is measured of flights with waypoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flockd.core.config import load_scenario
from flockd.core.data import data_path
from flockd.review.report.flight_folder import save_flight
from flockd.sim.swarm import fly
from tools.measure.measure_missions import main, measured, of_flight, on_exact_states


def test_a_path_with_known_distances() -> None:
    """Two drones 4 m apart, a metre a step: the middle passes 0.5 m east of the first waypoint, and ends 1 m short."""
    north = np.concatenate([np.arange(21.0), np.full(20, 20.0)])
    east = np.concatenate([np.full(21, 0.5), 0.5 + np.arange(1.0, 21.0)])
    middle = np.stack([north, east, np.full(41, -4.0)], axis=1)
    position = middle[:, None] + np.array([[0.0, -2.0, 0.0], [0.0, 2.0, 0.0]])
    velocity = np.gradient(position, axis=0)
    found = measured(np.arange(41.0), position, velocity, np.array([[20.0, 0.0], [20.0, 21.5]]), 20.0)
    assert found["waypoints_m"] == pytest.approx([0.5, 1.0])
    assert found["closest_m"] == found["widest_m"] == found["widest_at_the_end_m"] == 4.0
    assert found["order_flying"] == 1.0
    assert found["union_tail"] == 1.0


def test_drones_that_fly_apart_have_no_order_and_no_union() -> None:
    """One flies north and the other back, after a metre to the east together."""
    steps = np.arange(60.0)
    position = np.zeros((60, 2, 3))
    position[:, 0, 0], position[:, 1, 0] = steps, -steps
    position[..., 1] = 0.5 * steps[:, None]
    velocity = np.tile([[1.0, 0.5, 0.0], [-1.0, 0.5, 0.0]], (60, 1, 1))
    found = measured(steps, position, velocity, np.zeros((0, 2)), 20.0)
    assert found["order_flying"] == pytest.approx(-0.6)  # cosine of twice atan(1 / 0.5)
    assert found["union_tail"] == 0.0
    assert found["widest_m"] == 118.0


def test_a_flight_that_was_flown_before_is_measured_as_one_that_is_flown_now(tmp_path: Path) -> None:
    scenario = load_scenario(data_path("config") / "one_knows.yaml", {"duration_s": 12.0})
    flight = fly(scenario, perception="truth")
    save_flight(tmp_path, flight.log, flight.key_frames)
    before, now = of_flight(tmp_path), on_exact_states(scenario)
    assert {name: before[name] for name in now} == now
    assert now["waypoints_m"][0] > 5.0  # 27 m away, at half a metre a second
    assert before["mission"]["arrived"] is False


def test_a_folder_without_a_flight_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["measure_missions", str(tmp_path)])
    with pytest.raises(SystemExit):
        main()
    assert f"{tmp_path} is not the folder of a flight" in capsys.readouterr().err
