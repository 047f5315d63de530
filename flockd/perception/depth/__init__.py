"""Metric scale of depth: by the height above ground, or by the autopilot's velocity."""

from flockd.perception.depth.scale import VelocityScale, fix_by_height

__all__ = ["VelocityScale", "fix_by_height"]
