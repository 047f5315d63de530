"""Each fault of a real camera, alone, is in the images that a drone gets."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import Frame
from flockd.sim.scenario.imperfect_cameras import CamerasConfig
from tests.sim.cameras.test_scenario_cameras import flown_frames, scenario_with

FAULTS: Mapping[str, tuple[Mapping[str, Mapping[str, Any]], float]] = {
    "exposure": ({"shutter": {"exposure_s": 0.03}}, 0.1),
    "readout": ({"shutter": {"readout_s": 0.05}}, 0.1),
    "shake": ({"shake": {"rms_deg": 2.0, "frequency_hz": 40.0}}, 1.0),
    "shake in the exposure": ({"shake": {"rms_deg": 2.0, "frequency_hz": 200.0}, "shutter": {"exposure_s": 0.01}}, 1.0),
    "noise": ({"noise": {"gain": 8.0}}, 1.0),
    "automatics": ({"automatic": {"exposure": 1.0, "white_balance": 1.0}}, 1.0),
    "flare": ({"lens": {"flare": 0.2}}, 1.0),
    "dirt": ({"lens": {"dirt": 0.2}}, 0.5),
    "drops": ({"lens": {"drops": 0.2}}, 0.2),
    "JPEG": ({"compression": {"jpeg_quality": 30}}, 0.5),
}
"""What is configured, and by how many grey levels an image then differs from an ideal camera's at least."""


@cache
def _last(name: str) -> dict[str, Frame]:
    cameras = CamerasConfig.model_validate(FAULTS[name][0] if name else {})
    return flown_frames(scenario_with(cameras, image_noise=0.0), steps=2)[-1]


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_that_is_configured_is_seen(name: str) -> None:
    ideal, real = _last("")["front"].image.astype(float), _last(name)["front"].image.astype(float)
    assert np.abs(real - ideal).mean() > FAULTS[name][1]


def test_shaking_within_an_exposure_blurs_beside_turning_the_image() -> None:
    """Edges: neighbouring pixels of a sharp image differ more."""
    sharp, blurred = (
        np.abs(np.diff(_last(name)["front"].image.astype(float), axis=1)).mean()
        for name in ("shake", "shake in the exposure")
    )
    assert blurred < 0.9 * sharp
