"""Telemetry: what a drone knows, published for people and tools to watch. No drone reads it to fly."""

from flockd.onboard.telemetry.step_messages import TelemetrySink, publish_step
from flockd.onboard.telemetry.topics import TOPICS, Topic

__all__ = ["TOPICS", "TelemetrySink", "Topic", "publish_step"]
