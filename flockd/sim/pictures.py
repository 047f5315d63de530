"""A few moments of a flight as a pilot saw them, for the report's filmstrip."""

from __future__ import annotations

import numpy as np

from flockd.messages import PilotOutput
from flockd.pilot import StepTrace
from flockd.report.filmstrip import FilmstripFrame

_MOMENTS = 6
_SKY_M = 75.0
"""What the networks say is farther than this is sky."""


def pictured_steps(steps: int) -> set[int]:
    """Which of a flight's steps, counted from 0, become pictures: evenly spread from the first that has a flow."""
    return set(np.linspace(1, steps - 1, _MOMENTS).astype(int).tolist())


def picture(trace: StepTrace, output: PilotOutput, drone: int, name: str = "") -> list[FilmstripFrame]:
    """What a pilot worked with in the step that gave ``output``; nothing before its first."""
    view = trace.observation
    if view is None:
        return []
    cameras = view.cameras
    return [
        FilmstripFrame(
            time_s=output.time_s,
            drone=drone,
            name=name,
            cameras=tuple(cameras),
            images={name: c.image for name, c in cameras.items()},
            depth={name: np.where(c.depth < _SKY_M, c.depth, np.float32(np.inf)) for name, c in cameras.items()},
            labels={name: np.where(c.labels == 255, np.uint8(0), c.labels) for name, c in cameras.items()},
            flow=view.flows,
            track_ids={s.label: t for s, t in zip(output.detections, output.detection_tracks, strict=True)},
            ranges={s.label: float(np.linalg.norm(s.position)) for s in output.detections},
        )
    ]
