"""PX4's Position mode: what sticks ask for, and when they take over from another mode."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray

STICK_EXPO = 0.6
"""How much of a stick's curve is cubic, as PX4 1.18 has it and MPC_XY_MAN_EXPO before: slow near the middle."""
OVERRIDE_FILTER_S, OVERRIDE_SAMPLES = 0.05, 3
"""Of the sticks' speed, and for how many positions on end it has to have one sign."""


def stick_curve(sticks: FloatArray, deadzone: float = 0.0) -> FloatArray:
    """What sticks at -1 to 1 ask for in Position mode, -1 to 1 of the full speed."""
    moved = np.sign(sticks) * np.maximum(np.abs(sticks) - deadzone, 0.0) / (1.0 - deadzone)
    curved: FloatArray = (1.0 - STICK_EXPO) * moved + STICK_EXPO * moved**3
    return curved


class StickOverride:
    """Whether sticks move fast enough for the pilot to take over, by PX4 1.18's rule for MAN_OVERRIDE_SPD.

    The low-passed speed of a stick is above the threshold, and it has moved the same way several times on end.
    """

    def __init__(self) -> None:
        self._last: tuple[float, FloatArray] | None = None
        self._speed, self._sign, self._same = np.zeros(2), np.zeros(2), np.zeros(2)

    def moved(self, now_s: float, sticks: FloatArray, threshold: float) -> bool:
        """Takes a new position of the sticks (2,), -1 to 1. ``threshold``: travel a second; negative: they never do."""
        last, self._last = self._last, (now_s, sticks)
        if last is None or now_s <= last[0]:
            return False
        interval_s = now_s - last[0]
        speed = (sticks - last[1]) / interval_s
        self._speed = self._speed + interval_s / (OVERRIDE_FILTER_S + interval_s) * (speed - self._speed)
        sign = np.sign(speed)
        counted = np.where(sign == self._sign, self._same + 1, 1)
        self._same, self._sign = np.where(sign == 0, self._same, counted), np.where(sign == 0, self._sign, sign)
        fast = (np.abs(self._speed) > threshold) & (self._same >= OVERRIDE_SAMPLES)
        return threshold >= 0.0 and bool(fast.any())
