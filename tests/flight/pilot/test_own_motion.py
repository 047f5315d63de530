"""The own motion from an autopilot that errs and images that are noisy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.flight.pilot.own_motion import OwnMotion
from tests import make

STEP_S = 0.5
NORTH, STILL = np.array([1.0, 0.0, 0.0]), np.zeros(3)
ERRS = np.array([0.2, -0.15, 0.05])


class Drone(OwnMotion):
    """Of one that is stepped, by images with a noise of 2 cm."""

    def __init__(self) -> None:
        super().__init__(0.02)
        self.time_s: float | None = None

    def step(self, said: FloatArray | None, went: FloatArray | None, step_s: float = STEP_S) -> bool:
        """``said``: the autopilot's velocity at its end; ``went``: by images, but in the first step."""
        first, self.time_s = self.time_s is None, 0.0 if self.time_s is None else self.time_s + step_s
        state = make.vehicle(self.time_s, velocity_ned=said)
        return self.update(state, 0.0 if first else step_s, None if first else went)


@pytest.mark.parametrize("step_s", [0.1, 0.5])
def test_a_drone_that_speeds_up_knows_how_fast_it_is_now_although_its_autopilot_errs(step_s: float) -> None:
    """0.5 m/s^2: in steps of half a second the images' mean velocity is 0.125 m/s behind."""
    own = Drone()
    for k in range(round(4.0 / step_s)):
        now, went = 0.5 * k * step_s * NORTH, 0.5 * (k - 0.5) * step_s**2 * NORTH
        assert own.step(now + ERRS, went, step_s)
    assert own.error == pytest.approx(ERRS, abs=0.04)
    assert own.velocity == pytest.approx(now, abs=0.04)
    assert own.displacement == pytest.approx(went, abs=0.01)


@pytest.mark.parametrize("seen", [True, False], ids=["images", "no images"])
def test_the_sigma_is_what_the_displacement_errs_by(seen: bool) -> None:
    """PX4's wandering error and images with noise, a thousand steps: 4.6 % are beyond two sigma where it is right."""
    own, rng, kept = Drone(), np.random.default_rng(0), math.exp(-STEP_S / 3.0)
    errs, off = 0.15 * rng.normal(size=3), []
    for _ in range(1000):
        own.step(errs, rng.normal(0.0, 0.02, 3) if seen else None)
        off.append(STILL if own.displacement is None else own.displacement / own.sigma_m)
        errs = kept * errs + math.sqrt(1 - kept**2) * 0.15 * rng.normal(size=3)
    assert 0.02 < np.mean(np.abs(off[1:]) > 2.0) < 0.07
    assert own.sigma_m < 0.02 if seen else own.sigma_m == pytest.approx(0.15 * STEP_S, rel=0.05)


def test_an_impossible_motion_is_refused_once_and_believed_where_the_next_is_alike() -> None:
    own, fits = Drone(), list[bool]()
    for step, north_m in enumerate([0.0, 0.0, 4.0, 0.0, 0.0, 4.0, 4.0, 4.0]):
        fits.append(own.step(STILL, north_m * NORTH))
        if not fits[-1]:
            assert own.displacement == pytest.approx(STILL, abs=0.01)
            assert own.sigma_m > 0.03, "by the autopilot"
        elif step == 3:
            assert own.velocity == pytest.approx(STILL, abs=0.05), "it is forgotten"
    assert fits == [True, True, False, True, True, False, True, True]
    assert own.velocity == pytest.approx(8.0 * NORTH, rel=0.1)


@pytest.mark.parametrize(("scale", "speed_m_s", "wrong"), [(2.0, 1.0, True), (0.4, 2.0, True), (1.1, 2.0, False)])
def test_images_and_autopilot_that_disagree_for_long_are_told_and_make_the_sigma_large(
    scale: float, speed_m_s: float, wrong: bool
) -> None:
    """As over ground that is not at the height of home, with PX4's own errors of 0.15 m/s beside it."""
    own, rng, told = Drone(), np.random.default_rng(0), []
    for _ in range(40):
        own.step(speed_m_s * NORTH + rng.normal(0.0, 0.15, 3), scale * speed_m_s * STEP_S * NORTH)
        told.append(own.disagreement_m_s)
    assert any(told) is wrong
    if wrong:
        assert np.median(told[-20:]) == pytest.approx(abs(scale - 1.0) * speed_m_s, rel=0.2)
        assert own.sigma_m > 0.3 * STEP_S


def test_an_autopilot_whose_state_is_old_tells_less_than_the_images() -> None:
    """It says 1 m/s north in one state for five steps, while the drone turns round."""
    own, state = OwnMotion(0.02), make.vehicle(0.0, velocity_ned=NORTH)
    for step in range(6):
        assert own.update(state, STEP_S if step else 0.0, -NORTH * STEP_S if step else None)
    assert own.displacement == pytest.approx(-NORTH * STEP_S, abs=0.05)


@pytest.mark.parametrize("said", [None, 1e200 * NORTH], ids=["says none", "says nonsense"])
def test_without_the_autopilots_velocity_the_images_tell_alone(said: FloatArray | None) -> None:
    own = Drone()
    own.step(said, None)
    assert own.velocity is None and own.ahead(1.0)[0] is None
    own.step(said, NORTH)
    assert own.velocity == pytest.approx(2.0 * NORTH)
    own.step(said, None)
    assert own.displacement == pytest.approx(NORTH), "it flies on"
    assert own.sigma_m > 0.05
