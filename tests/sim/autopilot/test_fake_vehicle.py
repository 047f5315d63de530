"""The vehicle under the fake autopilot answers as PX4's does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.sim.autopilot.fake_vehicle import Demand, Flown

PX4_STEPS = np.loadtxt(Path(__file__).with_name("px4_steps.csv"), delimiter=",", skiprows=1)
"""Time (s), setpoint and estimated velocity (m/s, north and east each), at 20 Hz: PX4 1.18.0 in software, SIH
quadrotor, SIH_KDV 0.1, at real time, recorded once over MAVLink with setpoints of velocity, height and heading."""
WANDERS_M_S = 0.15
"""By so much PX4's estimate wanders."""


def _flown(setpoints: FloatArray, times: FloatArray) -> FloatArray:
    """The vehicle's velocities (n, 2) m/s when these setpoints come at these times."""
    vehicle, velocities = Flown(np.array([0.0, 0.0, -4.0])), []
    for setpoint, interval_s in zip(setpoints, np.diff(times, prepend=times[0]), strict=True):
        state = vehicle(Demand(setpoint, -4.0, 0.0), float(interval_s))
        velocities.append(state.velocity[:2])
    return np.array(velocities)


def test_it_answers_as_px4_did_to_the_same_setpoints() -> None:
    times, setpoints, px4 = PX4_STEPS[:, 0], PX4_STEPS[:, 1:3], PX4_STEPS[:, 3:5]
    error = _flown(np.roll(setpoints, 1, axis=0), times) - px4  # what comes now is flown from now on
    assert np.sqrt((error**2).mean()) < WANDERS_M_S
    for step in np.flatnonzero(np.linalg.norm(np.diff(setpoints, axis=0), axis=1) > 0.9):
        late = error[step : step + 60]  # three seconds, in which all of the answer lies
        assert np.abs(late.mean(axis=0)).max() < WANDERS_M_S


def test_for_its_dead_time_nothing_happens() -> None:
    times = np.arange(0.0, 2.0, 0.05)
    velocity = _flown(np.tile([1.0, 0.0], (len(times), 1)), times)
    assert velocity[times < 0.2, 0].max() == 0.0
    assert velocity[times > 0.3, 0].min() > 0.0
    assert velocity[-1, 0] == pytest.approx(1.0, abs=0.05)
