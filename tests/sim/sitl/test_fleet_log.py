"""The log of a fleet's flight, from what its daemons recorded and where the simulator had its drones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flockd.sim.sitl.fleet_log import FleetRun, fleet_log
from flockd.sim.sitl.ground_station import Poses
from tests import make
from tests.onboard.recording.made_up import drone_config, record


def test_a_motion_over_a_skipped_frame_set_is_not_in_the_log(tmp_path: Path) -> None:
    """Four frame sets were processed and one between them was not: of the motion that spans it there is no truth."""
    config = drone_config()
    outputs = record(tmp_path / f"{config.name}-1.mcap", flown=4)
    times = [outputs[0].time_s, outputs[1].time_s, outputs[1].time_s + 0.05, outputs[2].time_s, outputs[3].time_s]
    frames = tuple(
        Poses(time_s, np.full((1, 3), float(row)), np.eye(3)[None], np.ones((1, 3))) for row, time_s in enumerate(times)
    )
    run = FleetRun(began_s=times[0], wall_s=9.0, frames=frames, autopilot="PX4 1.18.0")
    assert outputs[-1].mission.takeover is not None
    run.handed_over = {config.name: "after 3 s its mission was over", "drone9": "after 2 s its battery was"}
    run.modes = {config.name: ["OFFBOARD", "LAND"]}
    log = fleet_log(make.scenario(drones=1), [config], run, tmp_path, 0.5)
    np.testing.assert_allclose(log.time_s, np.array(times) - times[0])
    assert log.recorded[:, 0].tolist() == [True, True, False, True, True]
    assert np.isfinite(log.ego_translation[:, 0, 0]).tolist() == [True, True, False, False, True]
    assert log.position[:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    metadata = log.metadata
    assert (metadata.autopilot, metadata.wall_s, metadata.drones) == ("PX4 1.18.0", 9.0, 1)
    assert metadata.fleet is not None
    assert metadata.fleet.frame_sets == 5
    assert metadata.fleet.mission_over == {config.name: "after 3 s its mission was over"}
    assert metadata.fleet.handed_over == {"drone9": "after 2 s its battery was"}
    assert metadata.fleet.modes == {config.name: ["OFFBOARD", "LAND"]}
    np.testing.assert_allclose(metadata.fleet.longest_step_s, 0.1)
