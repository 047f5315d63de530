"""Messages go through JSON and come back the same to the last bit."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import PilotOutput, VehicleState
from flockd.onboard.message_json import from_json, json_schema, to_json
from tests.onboard.recording.made_up import MadeUpPilot, drone_config, inputs


def through_text(kind: Any, value: object) -> Any:
    return from_json(kind, json.loads(json.dumps(to_json(value), allow_nan=False)))


@pytest.mark.parametrize("step", [0, 1], ids=["all fields", "without an optional one"])
def test_messages_come_back_to_the_last_bit(step: int) -> None:
    frames, vehicle = list(inputs(2))[step]
    output = MadeUpPilot(drone_config()).step(frames, vehicle)
    for message in (vehicle, output):
        back = through_text(type(message), message)
        kinds = [{name: type(value) for name, value in vars(one).items()} for one in (back, message)]
        assert kinds[0] == kinds[1]
        assert json.dumps(to_json(back)) == json.dumps(to_json(message)), "whose text restores each number exactly"
    R = through_text(VehicleState, vehicle).R_ned_body
    assert (R.dtype, R.tobytes()) == (np.float64, vehicle.R_ned_body.tobytes())


def test_any_double_comes_back() -> None:
    bits = np.random.default_rng(1).integers(0, 2**64, 20_000, dtype=np.uint64)
    for value in bits.view(np.float64).tolist():
        back = through_text(float, value)
        assert back == value or (math.isnan(back) and math.isnan(value))


def test_what_is_no_message_is_refused() -> None:
    good = to_json(next(inputs(1))[1])
    spoilt: object
    for spoilt in ({**good, "height_m": "high"}, {**good, "height_m": True}, {**good, "R_ned_body": 3}, [], None):
        with pytest.raises(ValueError, match=r"."):
            from_json(VehicleState, spoilt)
    del good["height_m"]
    with pytest.raises(ValueError, match="height_m is missing"):
        from_json(VehicleState, good)


def test_the_schema_names_every_field_with_its_type_and_shape() -> None:
    schema = json_schema(PilotOutput)
    assert schema["properties"].keys() == {part.name for part in fields(PilotOutput)}
    assert schema["properties"]["command"]["properties"]["yaw_rad"] == {"type": "number"}
    assert schema["properties"]["detections"]["items"]["properties"]["cameras"] == {
        "type": "array",
        "items": {"type": "string"},
    }
    assert "ego_motion" not in schema["required"]
    properties = json_schema(VehicleState)["properties"]
    assert properties["velocity_ned"] == {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
    assert (properties["R_ned_body"]["minItems"], properties["R_ned_body"]["maxItems"]) == (9, 9)
    assert "row by row" in properties["R_ned_body"]["description"]


def test_an_array_of_another_shape_is_refused() -> None:
    """Nine numbers are a matrix only where a matrix belongs, and nothing else is."""
    good = to_json(next(inputs(1))[1])
    for name, numbers, sentence in (
        ("R_ned_body", [1.0] * 8, "R_ned_body has 8 numbers, and an array of 3 x 3 has 9"),
        ("velocity_ned", [1.0] * 9, "velocity_ned has 9 numbers"),
        ("velocity_ned", [], "velocity_ned has 0 numbers"),
    ):
        with pytest.raises(ValueError, match=sentence):
            from_json(VehicleState, {**good, name: numbers})
    assert from_json(VehicleState, good).R_ned_body.shape == (3, 3)
