"""Flight logs keep their file format: what version 0.1.0 wrote still loads, and what is written now has its keys."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flockd.core.config import load_scenario
from flockd.core.data import data_path
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import FleetMetadata, FlightMetadata, Percentiles

OLD = Path(__file__).parent / "flight_0_1_0.npz"
"""Two drones of the paper's flight on exact states for 2 s, by `fly` and `FlightLog.save` of version 0.1.0."""


def meta_of(path: Path) -> dict[str, object]:
    with np.load(path) as file:
        loaded: dict[str, object] = json.loads(str(file["meta"]))
        return loaded


def test_a_flight_of_0_1_0_loads() -> None:
    log = FlightLog.load(OLD)
    assert log.position.shape == (4, 2, 3)
    assert log.has_truth
    assert not log.metadata.by_sight
    assert (log.metadata.scenario, log.metadata.drones, log.metadata.duration_s) == ("paper_flight", 2, 2.0)
    assert (log.metadata.seed, log.metadata.recorded, log.metadata.fleet) == (0, None, None)


def test_the_file_keeps_its_arrays_and_keys(tmp_path: Path) -> None:
    """An older flockd, and scripts, read the same keys: also those whose value is null, and no others."""
    again = tmp_path / "flight.npz"
    FlightLog.load(OLD).save(again)
    assert meta_of(again) == meta_of(OLD)
    with np.load(OLD) as before, np.load(again) as after:
        assert sorted(before.files) == sorted(after.files)
        for name in before.files:
            assert before[name].tobytes() == after[name].tobytes() or name == "meta"


def test_metadata_of_a_fleet_comes_back(tmp_path: Path) -> None:
    fleet = FleetMetadata(
        speed_factor=0.5, cores={"daemons": 1.5}, frame_sets=4, frame_sets_looked_at={"drone1": 3},
        longest_step_s=1.0, motions_over_more_than_one_frame_set=1,
        frames_late_s=Percentiles(p50=0.1, p95=float("nan")),
        autopilot_clock_rates=[0.5], order_last_20s=1.0, union_last_20s=1.0, handed_over={"drone1": "it landed"},
        exit_codes={"drone1": 0}, notes=["a note"],
    )  # fmt: skip
    drone = load_scenario(data_path("config") / "paper_flight.yaml").drone
    metadata = FlightMetadata.of_configuration(
        drone, scenario="two", perception="learned", drones=2, duration_s=2.0, seed=None, wall_s=3.0, fleet=fleet
    )
    old = FlightLog.load(OLD)
    path = tmp_path / "flight.npz"
    FlightLog(**{**vars(old), "metadata": metadata}).save(path)
    written = meta_of(path)
    assert written["seed"] is None
    assert "recorded" not in written
    again = FlightLog.load(path).metadata
    assert again.fleet is not None
    assert np.isnan(again.fleet.frames_late_s.p95)
    assert again.fleet.handed_over == {"drone1": "it landed"}
    assert again.separation_distance_m == drone.flocking.separation_distance_m


def test_facts_that_no_flight_has_are_refused() -> None:
    drone = load_scenario(data_path("config") / "paper_flight.yaml").drone
    with pytest.raises(ValueError, match="duratoin_s"):
        FlightMetadata.of_configuration(
            drone, scenario="two", perception="learned", drones=2, duration_s=2.0, duratoin_s=2.0
        )
