"""Vectors of a peer that are too short, too long or null end nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from foxglove.messages import Timestamp

from flockd.fleet.foxglove.fleet_scene import (
    SCENE_TOPICS,
    SceneDrone,
    body_transform,
    location_fix,
    place_of,
    scene_update,
)
from flockd.fleet.page.drone_rows import drone_rows
from flockd.fleet.watcher import Heard, Watched


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
    row, stamp = drone_rows([watched], {}, 0.0)["f/d"], Timestamp(1)
    drone = SceneDrone("d", row, np.zeros(3), [], "#0072b2")
    assert body_transform(stamp, drone)
    for topic in SCENE_TOPICS:
        assert scene_update(topic, [drone], stamp)
    known = len(vector) >= 2 and None not in vector
    assert (location_fix(stamp, "d", row) is not None) == known
    assert (place_of(row) is not None) == known
