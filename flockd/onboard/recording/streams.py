"""What a recording consists of: the streams that replay needs, those of the table of topics, and those for viewers."""

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
"""Facts of a recording that was made of another; the last two of earlier versions."""
LEARNED_SIZE = "learned_size"
"""A fact of a flight: what its pilot began with of the others' size, as JSON."""
FLIGHT_NUMBER = "flight_number"
"""A fact of a flight: one more than the largest of the drone's recordings in the folder."""
CONFIGURATION = "configuration.json"


@dataclass(frozen=True)
class FrameEntry:
    """One image of a frame set; the image itself is the camera's message with the step's number."""

    camera: str
    time_s: float
    sequence: int


@dataclass(frozen=True)
class StepFrames:
    """Which images went into a step."""

    step: int
    """Counted from 0 over the whole recording; a missing number is a step that was dropped."""
    time_s: float
    frames: tuple[FrameEntry, ...]


def _json_stream(topic: str, kind: Any) -> Stream:
    name = f"flockd.{kind.__name__.removesuffix('Message')}"
    return Stream(topic, "json", name, json.dumps(json_schema(kind)).encode())


FRAMES = _json_stream("/frames", StepFrames)
VEHICLE = _json_stream("/vehicle", VehicleState)
ORDER = _json_stream("/order", MissionOrder)
"""Orders of the steps in which the pilot took an operator's."""
OUTPUT = _json_stream("/output", PilotOutput)
TRUTH = _json_stream("/truth", Truth)
"""Only in recordings of simulated flights."""
TABLE = {key: _json_stream(f"/{key}", topic.type) for key, topic in TOPICS.items() if topic.recorded}
"""The telemetry that the table of topics marks as recorded."""


def is_image(topic: str) -> bool:
    """Whether this stream holds a camera's images."""
    return topic.endswith("/image")


def nanoseconds(time_s: float) -> int:
    """A time as MCAP has it; the exact one stands in the messages themselves."""
    return max(0, round(time_s * 1e9))
