"""Vectors of a peer that are too short, too long or null end nothing."""

from __future__ import annotations

import math
from typing import Any

import pytest
from foxglove.messages import Timestamp

from flockd.fleet.foxglove.camera_messages import Cameras
from flockd.fleet.foxglove.map_places import enu, location_fix
from flockd.fleet.foxglove.scene_messages import SCENE_TOPICS, Scene, scene_update
from flockd.fleet.page.drone_rows import Known, drone_rows
from flockd.fleet.watcher import Heard, Watched


@pytest.mark.parametrize(
    ("ned", "expected"),
    [
        ([1, 2, 3], [2, 1, -3]),
        ([1, None, 3], [0, 1, -3]),
        ([1], [0, 1, 0]),
        ([], [0, 0, 0]),
        ([1, 2, 3, 4], [2, 1, -3]),
    ],
)
def test_north_east_down_becomes_east_north_up(ned: list[float | None], expected: list[float]) -> None:
    assert enu(ned).tolist() == expected


@pytest.mark.parametrize("vector", [[], [1.0], [None, None, None], [1.0, 2.0, 3.0, 4.0]])
def test_a_scene_is_drawn_whatever_a_peer_sends(vector: list[float | None]) -> None:
    neighbour: dict[str, Any] = {
        "track": 1, "position_ned": vector, "position_sigma_m": None, "unseen_s": None, "confirmed": True
    }  # fmt: skip
    messages: dict[str, Any] = {
        "state": {"height_m": None, "yaw_deg": None, "velocity_ned": vector, "position_ne": vector, "home_deg": vector},
        "command": {"velocity_ne": vector},
        "mission": {"goal_ne": vector, "goal_height_m": None, "sentence": ""},
        "neighbours": {"neighbours": [neighbour]},
        "obstacles": {"range_m": vector},
    }
    watched = Watched("f", "d", True, {topic: Heard(0.0, message) for topic, message in messages.items()}, seen=True)
    row = drone_rows([watched], {}, 0.0)["f/d"]
    drone, stamp = Scene().drone("d", row, enu(()), messages), Timestamp(1)
    for topic in SCENE_TOPICS:
        assert scene_update(topic, [drone], stamp)
    fix = location_fix(stamp, "d", messages["state"])
    assert (fix is None) == (len(vector) < 2 or None in vector)
    assert Cameras(Known()).tracks(stamp, "front", b"no picture", messages)
    assert math.isfinite(drone.place.sum())
