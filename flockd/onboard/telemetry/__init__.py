"""Telemetry: a drone's state, published for people and tools. No drone reads it to fly."""

from flockd.onboard.telemetry.step_messages import TelemetrySink, publish_step
from flockd.onboard.telemetry.topics import TOPICS, Topic

__all__ = ["TOPICS", "TelemetrySink", "Topic", "publish_step"]
