"""What `flockd ros` makes of telemetry, worked out by hand: transforms for tf, and the state with its reasons."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.fleet.drone_rows import WORST_FIRST, Known, drone_rows, origin_of
from flockd.fleet.ros.fleet_bridge import _LEVELS, _status, _transforms
from flockd.fleet.ros.fleet_markers import markers
from flockd.fleet.ros.message_trees import Names
from flockd.fleet.ros.ros_frames import rotation_of
from flockd.fleet.watcher import Heard, Watched
from flockd.onboard.telemetry.topics import AboutMessage, StateMessage
from tests.make import flight_message

ABOUT = AboutMessage(version="1", configuration={"mission": {"origin_m": [3.0, -4.0]}}, commands=[])
STATE = StateMessage(
    time_s=1.0, height_m=5.0, roll_deg=0.0, pitch_deg=0.0, yaw_deg=90.0, velocity_ned=[1.0, 0.0, 0.0],
    position_ne=[10.0, 20.0], home_deg=[47.0, 8.0],
)  # fmt: skip
FLIGHT = flight_message(
    state="degraded", reasons=[{"event": "x", "sentence": "the battery is low; land"}], battery_share=0.4, height_m=5.0
)


def row() -> dict[str, Any]:
    topics = {"state": Heard(0.0, {**STATE}), "flight": Heard(0.0, FLIGHT)}
    drone = Watched("f", "drone1", alive=True, topics=topics, seen=True)
    return drone_rows([drone], {"f/drone1": Known(ABOUT)}, 0.0)["f/drone1"]


def moved(transform: dict[str, Any], point: list[float]) -> FloatArray:
    """A point of the child's frame in its parent's."""
    place = np.array(list(transform["transform"]["translation"].values()))
    turn = np.array(list(transform["transform"]["rotation"].values()))
    found: FloatArray = rotation_of(turn) @ np.array(point) + place
    return found


def test_transforms_lead_from_the_map_to_the_body() -> None:
    """East 20, north 10, up 5, facing east."""
    tree = _transforms(0, Names("drone1"), STATE, row())
    assert tree is not None
    by_child = {one["child_frame_id"]: one for one in tree["transforms"]}
    parents = {child: one["header"]["frame_id"] for child, one in by_child.items()}
    assert parents == {"drone1/odom": "map", "drone1/level": "drone1/odom", "drone1/base_link": "drone1/odom"}
    np.testing.assert_allclose(moved(by_child["drone1/base_link"], [1.0, 0.0, 0.0]), [21.0, 10.0, 5.0], atol=1e-9)
    np.testing.assert_allclose(moved(by_child["drone1/level"], [0.0, 1.0, 0.0]), [20.0, 11.0, 5.0], atol=1e-9)
    assert _transforms(0, Names("drone1"), {**STATE, "position_ne": None}, row()) is None


def test_a_state_comes_with_its_reasons_and_its_level() -> None:
    status = _status("drone1", row())
    assert (status["level"], status["name"]) == (1, "drone1: flockd"), "WARN"
    assert status["message"] == "degraded: the battery is low; land"
    assert {"key": "battery_share", "value": "0.4"} in status["values"]
    assert {"key": "armed", "value": "true"} in status["values"]
    assert set(_LEVELS) == set(WORST_FIRST), "every state has a level"


def test_markers_stand_where_the_drone_is() -> None:
    """In `map`; the course is the own velocity over two seconds: 1 m/s to the north."""
    first, *drawn = markers(0, "drone1", 0, row())["markers"]
    assert first["action"] == 3, "what was drawn before is deleted"
    assert list(drawn[0]["pose"]["position"].values()) == [20.0, 10.0, 5.0]
    assert [list(point.values()) for point in drawn[3]["points"]] == [[20.0, 10.0, 5.0], [20.0, 12.0, 5.0]]
    assert len({marker["id"] for marker in drawn}) == len(drawn)
    assert len(markers(0, "drone1", 0, {**row(), "position_ne": None})["markers"]) == 1


@pytest.mark.parametrize("mission", [None, {}, {"origin_m": [1.0]}, {"origin_m": ["a", "b"]}])
def test_an_origin_that_a_peer_does_not_tell_is_none(mission: Any) -> None:
    assert origin_of({"mission": mission}) is None
    assert origin_of(ABOUT["configuration"]) == [3.0, -4.0]
