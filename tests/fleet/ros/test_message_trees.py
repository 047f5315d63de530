"""What goes out to ROS 2, against values worked out by hand from REP 103, REP 117 and the messages' definitions: single
messages, and what `flockd ros` makes of a drone's telemetry."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.fleet.drone_rows import WORST_FIRST, Known, drone_rows, origin_of
from flockd.fleet.ros import message_trees as trees
from flockd.fleet.ros.fleet_bridge import _LEVELS, _status, _transforms
from flockd.fleet.ros.fleet_markers import markers
from flockd.fleet.ros.message_trees import Names
from flockd.fleet.ros.ros_frames import rotation_of
from flockd.fleet.watcher import Heard, Watched
from flockd.onboard.telemetry.topics import AboutMessage, NeighbourMessage, ObstaclesMessage, StateMessage
from tests.make import flight_message

NAMES = Names("drone1")
STATE = StateMessage(
    time_s=5.0, height_m=3.0, roll_deg=0.0, pitch_deg=0.0, yaw_deg=90.0, velocity_ned=[1.0, 0.5, -0.25],
    position_ne=[1.0, 2.0], home_deg=None,
)  # fmt: skip
SEEN = NeighbourMessage(
    track=7, position_ned=[1.0, 2.0, 3.0], velocity_ned=[0.1, 0.2, 0.3], position_sigma_m=0.5,
    velocity_sigma_m_s=0.2, age_s=4.0, unseen_s=0.25, confirmed=True,
)  # fmt: skip


def values(tree: dict[str, Any]) -> list[float]:
    return list(tree.values())


def test_an_odometry_has_its_twist_in_the_body() -> None:
    """Facing east: north is to the left, east is ahead. 0.25 m/s down is negative in NED, so it climbs."""
    tree = trees.state_odometry(1_700_000_000_123_456_789, NAMES, STATE)
    assert tree is not None
    assert tree["header"] == {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": "drone1/odom"}
    assert tree["child_frame_id"] == "drone1/base_link"
    pose, motion = tree["pose"]["pose"], tree["twist"]["twist"]
    np.testing.assert_allclose(values(pose["position"]), [2.0, 1.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(values(pose["orientation"]), [0.0, 0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(values(motion["linear"]), [0.5, 1.0, 0.25], atol=1e-9)
    assert tree["twist"]["covariance"][0] == 0.0


def test_what_is_not_known_is_not_made_up() -> None:
    assert trees.state_odometry(0, NAMES, {**STATE, "position_ne": None}) is None
    tree = trees.state_odometry(0, NAMES, {**STATE, "velocity_ned": None})
    assert tree is not None
    assert tree["twist"]["covariance"][0] == -1.0, "not a standstill"


def test_neighbours_with_their_variances_in_a_cloud() -> None:
    """A point by hand: offsets as the message's own fields say, in the order of the poses."""
    broken: Any = {**SEEN, "position_ned": [None, 0.0, 0.0]}
    poses, cloud = (make(9, NAMES, [broken, SEEN]) for make in (trees.neighbour_poses, trees.tracks))
    assert [values(pose["position"]) for pose in poses["poses"]] == [[2.0, 1.0, -3.0]]
    assert (cloud["header"]["frame_id"], cloud["width"], cloud["row_step"]) == ("drone1/level", 1, len(cloud["data"]))
    codes = {8: "d", 6: "I", 2: "B"}
    found = {
        field["name"]: struct.unpack_from(f"<{codes[field['datatype']]}", cloud["data"], field["offset"])[0]
        for field in cloud["fields"]
    }
    assert found == {
        "x": 2.0, "y": 1.0, "z": -3.0, "vx": 0.2, "vy": 0.1, "vz": -0.3, "position_variance": 0.25,
        "velocity_variance": pytest.approx(0.04), "age": 4.0, "unseen": 0.25, "track": 7, "confirmed": 1,
    }  # fmt: skip


def test_a_scan_clears_nothing_that_was_not_seen() -> None:
    """Something 4 m to the east, free to 10 m in the north, free to 6 m only in the south, unseen elsewhere."""
    range_m: list[Any] = [4.0 if sector == 18 else None for sector in range(72)]
    seen_m = [{18: 4.0, 0: 10.0, 36: 6.0}.get(sector, 0.0) for sector in range(72)]
    tree = trees.scan(0, NAMES, ObstaclesMessage(time_s=0.0, range_m=range_m, seen_m=seen_m))
    assert tree is not None
    at = {
        degrees: round((math.radians(degrees) - tree["angle_min"]) / tree["angle_increment"])
        for degrees in (0, 90, -90, -180)
    }
    ranges = tree["ranges"]
    assert ranges[at[0]] == 4.0, "east is angle 0"
    assert math.isinf(ranges[at[90]]), "north is free as far as the scan reaches"
    assert math.isnan(ranges[at[-90]]), "south is free, but not that far"
    assert tree["intensities"][at[-90]] == 6.0
    assert math.isnan(ranges[at[-180]]), "west was not looked at"
    assert tree["range_max"] == 10.0
    assert tree["angle_max"] == pytest.approx(math.pi - 2 * math.pi / 72)
    assert trees.scan(0, NAMES, ObstaclesMessage(time_s=0.0, range_m=[], seen_m=[])) is None


ABOUT = AboutMessage(version="1", configuration={"mission": {"origin_m": [3.0, -4.0]}}, commands=[])
FLIGHT = flight_message(
    state="degraded", reasons=[{"event": "x", "sentence": "the battery is low; land"}], battery_share=0.4, height_m=3.0
)


def row() -> dict[str, Any]:
    topics = {"state": Heard(0.0, {**STATE}), "flight": Heard(0.0, FLIGHT)}
    drone = Watched("f", "drone1", alive=True, topics=topics, seen=True)
    return drone_rows([drone], {"f/drone1": Known(ABOUT)}, 0.0)["f/drone1"]


def placed(transform: dict[str, Any], point: list[float]) -> FloatArray:
    """A point of the child's frame in its parent's."""
    place = np.array(list(transform["transform"]["translation"].values()))
    turn = np.array(list(transform["transform"]["rotation"].values()))
    found: FloatArray = rotation_of(turn) @ np.array(point) + place
    return found


def test_transforms_lead_from_the_map_to_the_body() -> None:
    """East 2, north 1, up 3, facing east."""
    tree = _transforms(0, NAMES, STATE, row())
    assert tree is not None
    by_child = {one["child_frame_id"]: one for one in tree["transforms"]}
    parents = {child: one["header"]["frame_id"] for child, one in by_child.items()}
    assert parents == {"drone1/odom": "map", "drone1/level": "drone1/odom", "drone1/base_link": "drone1/odom"}
    np.testing.assert_allclose(placed(by_child["drone1/base_link"], [1.0, 0.0, 0.0]), [3.0, 1.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(placed(by_child["drone1/level"], [0.0, 1.0, 0.0]), [2.0, 2.0, 3.0], atol=1e-9)
    assert _transforms(0, NAMES, {**STATE, "position_ne": None}, row()) is None


def test_a_state_comes_with_its_reasons_and_its_level() -> None:
    status = _status("drone1", row())
    assert (status["level"], status["name"]) == (1, "drone1: flockd"), "WARN"
    assert status["message"] == "degraded: the battery is low; land"
    assert {"key": "battery_share", "value": "0.4"} in status["values"]
    assert {"key": "armed", "value": "true"} in status["values"]
    assert set(_LEVELS) == set(WORST_FIRST), "every state has a level"


def test_markers_stand_where_the_drone_is() -> None:
    """In `map`; the course is the own velocity over two seconds: 1 m/s to the north, 0.5 to the east, 0.25 up."""
    first, *drawn = markers(0, "drone1", 0, row())["markers"]
    assert first["action"] == 3, "what was drawn before is deleted"
    assert list(drawn[0]["pose"]["position"].values()) == [2.0, 1.0, 3.0]
    assert [list(point.values()) for point in drawn[3]["points"]] == [[2.0, 1.0, 3.0], [3.0, 3.0, 3.5]]
    assert len({marker["id"] for marker in drawn}) == len(drawn)
    assert len(markers(0, "drone1", 0, {**row(), "position_ne": None})["markers"]) == 1


@pytest.mark.parametrize("mission", [None, {}, {"origin_m": [1.0]}, {"origin_m": ["a", "b"]}])
def test_an_origin_that_a_peer_does_not_tell_is_none(mission: Any) -> None:
    assert origin_of({"mission": mission}) is None
    assert origin_of(ABOUT["configuration"]) == [3.0, -4.0]
