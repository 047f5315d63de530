"""The streams of a recording: those that replay needs, those of the table of topics, and those for viewers."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from flockd.core.messages import MissionOrder, PilotOutput, VehicleState
from flockd.onboard.message_json import json_schema
from flockd.onboard.recording.mcap_file import Stream
from flockd.onboard.recording.truth import Truth
from flockd.onboard.telemetry import TOPICS

FORMAT = "1"
"""Version of this layout; a reader refuses others."""
FLIGHT_NOTE = "flockd"
MODELS_NOTE = "models"
END_NOTE = "end"
REPLAYED = "replayed_from"
EDITED = (REPLAYED, "recovered_from", "cut_from")
"""Facts of a recording made from another one; the last two come from earlier versions."""
LEARNED_SIZE = "learned_size"
"""A fact of a flight: the others' size with which its pilot began, as JSON."""
FLIGHT_NUMBER = "flight_number"
"""A fact of a flight: the largest number among the drone's recordings in the folder, plus one."""
CONFIGURATION = "configuration.json"


@dataclass(frozen=True)
class FrameEntry:
    """One image of a frame set; the image itself is the camera's message with the step's number."""

    camera: str
    time_s: float
    sequence: int


@dataclass(frozen=True)
class StepFrames:
    """The images of a step."""

    step: int
    """Counted from 0 over the whole recording; a missing number is a dropped step."""
    time_s: float
    frames: tuple[FrameEntry, ...]


def _json_stream(topic: str, kind: Any) -> Stream:
    name = f"flockd.{kind.__name__.removesuffix('Message')}"
    return Stream(topic, "json", name, json.dumps(json_schema(kind)).encode())


FRAMES = _json_stream("/frames", StepFrames)
VEHICLE = _json_stream("/vehicle", VehicleState)
ORDER = _json_stream("/order", MissionOrder)
"""Operators' orders, with the step that took each."""
OUTPUT = _json_stream("/output", PilotOutput)
TRUTH = _json_stream("/truth", Truth)
"""Only in recordings of simulated flights."""
TABLE = {key: _json_stream(f"/{key}", topic.type) for key, topic in TOPICS.items() if topic.recorded}
"""The telemetry that the table of topics marks as recorded."""


def is_image(topic: str) -> bool:
    """Whether this stream holds a camera's images."""
    return topic.endswith("/image")


def nanoseconds(time_s: float) -> int:
    """A time as in MCAP; the messages themselves contain the exact one."""
    return max(0, round(time_s * 1e9))
