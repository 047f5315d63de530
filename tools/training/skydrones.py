"""Which clips of the `skydrones` data set are for what."""

from __future__ import annotations

from pathlib import Path

SPLITS = ("training", "tuning", "validation")
"""To train on, to choose a threshold by, to measure on."""
_CLIPS_A_SCENE = 10
"""Neighbouring clips show the same scene: such blocks stay on one side."""
_TUNING, _VALIDATION = (11,), (3, 9)
"""Blocks: clips from 111 on; 31-40 and 91-100."""


def split_of(clip: str) -> str:
    """One of ``SPLITS``, by a clip's name such as V_DRONE_031.mp4."""
    block = (int(Path(clip).stem.split("_")[-1]) - 1) // _CLIPS_A_SCENE
    return "validation" if block in _VALIDATION else "tuning" if block in _TUNING else "training"
