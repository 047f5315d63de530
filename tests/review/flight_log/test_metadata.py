"""Metadata of flights as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from flockd.core.data import data_path
from flockd.review.flight_log.metadata import FleetMetadata, FlightMetadata
from flockd.sim.scenario import load_scenario


def test_metadata_of_a_fleet_comes_back(tmp_path: Path) -> None:
    fleet = FleetMetadata(
        speed_factor=0.5, frame_sets=4, longest_step_s=1.0, order_last_20s=float("nan"),
        handed_over={"drone1": "it landed"}, exit_codes={"drone1": 0}, notes=["a note"],
    )  # fmt: skip
    drone = load_scenario(data_path("config") / "paper_flight.yaml").drone
    metadata = FlightMetadata.of_configuration(
        drone, scenario="two", perception="learned", drones=2, duration_s=2.0, seed=None, wall_s=3.0, fleet=fleet
    )
    written = metadata.model_dump_json(exclude_unset=True)
    assert json.loads(written)["seed"] is None
    assert "recorded" not in json.loads(written)
    again = FlightMetadata.model_validate_json(written)
    assert again.fleet is not None
    assert np.isnan(again.fleet.order_last_20s)
    assert again.fleet.handed_over == {"drone1": "it landed"}
    assert again.separation_distance_m == drone.flocking.separation_distance_m
