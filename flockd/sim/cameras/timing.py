"""When real cameras expose, what their time stamps say, and which images never come."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.sim.scenario.imperfect_cameras import CameraTimingConfig


@dataclass(frozen=True)
class Shot:
    """One image's times."""

    stamp_s: float
    """As it says itself."""
    shown_s: float
    """When its middle row was exposed."""
    comes: bool


class CameraClock:
    """One camera's: where in its period it runs is drawn once, jitter and drops for each image."""

    def __init__(self, config: CameraTimingConfig, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._before_s = float(config.apart_s * rng.random())

    def shot(self, time_s: float) -> Shot:
        """Of the frame set of a time."""
        jitter, dropped = self._rng.random(2)
        stamp_s = time_s - self._before_s
        shown_s = stamp_s - self._config.delay_s - self._config.jitter_s * float(jitter)
        return Shot(stamp_s, shown_s, bool(dropped >= self._config.dropped))
