"""Captures key frames: which steps of a flight, and what the pilot worked with in them."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import PilotOutput
from flockd.flight.pilot import StepTrace
from flockd.review.flight_log.key_frames import KeyFrame

_KEY_FRAMES, _KEY_FRAMES_APART = 6, 6
"""In a flight, and at least how many steps apart: each costs a second of the report's time and 0.2 MB of its size."""
_SKY_M = 75.0
"""Estimated depth beyond this is shown as sky."""


def key_frame_steps(steps: int) -> set[int]:
    """Which of a flight's steps, counted from 0, are key frames: evenly spread from the first that has optical flow."""
    count = min(max(steps // _KEY_FRAMES_APART, 2), _KEY_FRAMES)
    return set(np.linspace(1, steps - 1, count).astype(int).tolist())


def capture(trace: StepTrace, output: PilotOutput, drone: int, name: str = "") -> list[KeyFrame]:
    """What a pilot worked with in the step that gave ``output`` and ``trace``.

    Empty before its first step, and where no camera had a usable image, as of a drone that touched the ground.
    """
    view = trace.observation
    if view is None or not view.cameras:
        return []
    cameras = view.cameras
    return [
        KeyFrame(
            time_s=output.time_s,
            drone=drone,
            name=name,
            cameras=tuple(cameras),
            images={name: c.image for name, c in cameras.items()},
            depth={
                name: np.where(c.depth < _SKY_M, c.depth, np.float32(np.inf))
                for name, c in cameras.items()
                if c.depth is not None
            },
            labels={name: np.where(c.labels == 255, np.uint8(0), c.labels) for name, c in cameras.items()},
            flow=view.flows,
            track_ids={s.label: t for s, t in zip(output.detections, output.detection_tracks, strict=True)},
            ranges={s.label: float(np.linalg.norm(s.position)) for s in output.detections},
        )
    ]
