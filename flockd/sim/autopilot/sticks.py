"""What a remote control's sticks ask for in PX4's Position mode."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray

STICK_EXPO = 0.6
"""How much of a stick's curve is cubic, as PX4 1.18 has it and MPC_XY_MAN_EXPO before: slow near the middle."""


def stick_curve(sticks: FloatArray, deadzone: float = 0.0) -> FloatArray:
    """What sticks at -1 to 1 ask for in Position mode, -1 to 1 of the full speed."""
    moved = np.sign(sticks) * np.maximum(np.abs(sticks) - deadzone, 0.0) / (1.0 - deadzone)
    curved: FloatArray = (1.0 - STICK_EXPO) * moved + STICK_EXPO * moved**3
    return curved
