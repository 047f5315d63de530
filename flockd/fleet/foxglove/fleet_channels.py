"""Every topic that the server publishes, made when there is something for it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from foxglove import Channel, Context, Schema
from foxglove.channels import (
    CompressedImageChannel,
    FrameTransformsChannel,
    ImageAnnotationsChannel,
    LocationFixChannel,
    LogChannel,
    SceneUpdateChannel,
)
from foxglove.messages import CameraCalibration

from flockd.fleet.foxglove.camera_messages import frame_of
from flockd.fleet.foxglove.fleet_message import FleetMessage
from flockd.fleet.foxglove.json_schemas import json_schema
from flockd.fleet.foxglove.scene_messages import SCENE_TOPICS
from flockd.onboard.telemetry.topics import TOPICS

FLEET, LOG, TRANSFORMS = "/fleet", "/log", "/tf"
JSON_TOPICS = tuple(topic for topic in TOPICS if topic != "events")
"""Of each drone, as telemetry has them; events go to `LOG`."""
_Channel = TypeVar("_Channel")


class CameraChannels:
    """A camera's pictures, their calibration (as serialized messages), and the drones in them."""

    def __init__(self, topic: str, context: Context) -> None:
        self.image = CompressedImageChannel(f"{topic}/image", context=context)
        self.calibration = Channel(
            f"{topic}/calibration", schema=CameraCalibration.get_schema(), message_encoding="protobuf", context=context
        )
        self.tracks = ImageAnnotationsChannel(f"{topic}/tracks", context=context)


class FleetChannels:
    """Channels by topic, of one context."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.fleet = self._json(FLEET, FleetMessage)
        self.log = LogChannel(LOG, context=context)
        self.transforms = FrameTransformsChannel(TRANSFORMS, context=context)
        self.scene = {topic: SceneUpdateChannel(topic, context=context) for topic in SCENE_TOPICS}
        self._made: dict[str, Any] = {}

    def message(self, drone: str, topic: str) -> Channel:
        """Of one topic of `JSON_TOPICS`."""
        return self._get(f"/{drone}/{topic}", lambda name: self._json(name, TOPICS[topic].type))

    def fix(self, drone: str) -> LocationFixChannel:
        """Where a drone is on the earth."""
        return self._get(f"/{drone}/fix", lambda name: LocationFixChannel(name, context=self._context))

    def camera(self, drone: str, camera: str) -> CameraChannels:
        """Of one camera."""
        return self._get(f"/{frame_of(drone, camera)}", lambda name: CameraChannels(name, self._context))

    def _get(self, topic: str, make: Callable[[str], _Channel]) -> _Channel:
        if topic not in self._made:
            self._made[topic] = make(topic)
        channel: _Channel = self._made[topic]
        return channel

    def _json(self, topic: str, kind: type) -> Channel:
        schema = Schema(name=f"flockd.{kind.__name__}", encoding="jsonschema", data=_bytes(json_schema(kind)))
        return Channel(topic, schema=schema, message_encoding="json", context=self._context)


def _bytes(value: Mapping[str, object]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()
