"""How a drone follows its setpoints, fitted to made-up logs whose time constant and dead time are known."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.review.flight_log.autopilot_log import AutopilotLog
from flockd.review.flight_log.velocity_response import velocity_response

FINE_S = 0.001


def _log(
    tau: float, dead_s: float, *, seconds: float = 20.0, pause: bool = False, step_m_s: float = 1.0
) -> AutopilotLog:
    """Setpoints at 20 Hz that turn by a right angle every 2 s; flown at 50 Hz, by Euler steps of a millisecond."""
    asked_s = np.arange(0.0, seconds, 0.05)
    angle = np.pi / 2 * (asked_s // 2.0)
    asked = step_m_s * np.column_stack([np.cos(angle), np.sin(angle)])
    if pause:
        asked[(asked_s > 8.0) & (asked_s < 9.0)] = np.nan
    velocity, fine = np.zeros(2), []
    for now_s in np.arange(0.0, seconds, FINE_S):
        held = asked[max(int((now_s - dead_s) / 0.05 + 1e-9), 0)] if now_s >= dead_s else np.zeros(2)
        velocity = velocity + FINE_S / tau * (np.where(np.isfinite(held), held, 0.0) - velocity)
        fine.append(velocity)
    flown: FloatArray = np.array(fine)[:: round(0.02 / FINE_S)]
    noise = np.random.default_rng(0).normal(0.0, 0.03, flown.shape)
    return AutopilotLog(
        source="made up", placed_by="nothing", drone=0, setpoint_time_s=asked_s, setpoint_velocity=asked,
        setpoint_height_m=np.full(len(asked), 5.0), flown_time_s=np.arange(len(flown)) / 50.0,
        flown_velocity=flown + noise, flown_height_m=np.full(len(flown), 5.0), modes=(), failsafes=(), said=(),
    )  # fmt: skip


@pytest.mark.parametrize(("tau", "dead_s"), [(0.25, 0.0), (0.5, 0.1), (0.9, 0.3)])
@pytest.mark.parametrize("pause", [False, True])
def test_the_response_is_found(tau: float, dead_s: float, *, pause: bool) -> None:
    fitted = velocity_response(_log(tau, dead_s, pause=pause))
    assert fitted is not None
    assert fitted.time_constant_s == pytest.approx(tau, rel=0.08)
    assert fitted.dead_time_s == pytest.approx(dead_s, abs=0.04)
    assert fitted.error_m_s == pytest.approx(0.03, abs=0.01)


@pytest.mark.parametrize(("seconds", "step_m_s"), [(4.0, 1.0), (20.0, 0.01)])
def test_from_too_little_nothing_is_fitted(seconds: float, step_m_s: float) -> None:
    assert velocity_response(_log(0.5, 0.1, seconds=seconds, step_m_s=step_m_s)) is None


def test_an_autopilot_that_never_had_a_setpoint_has_no_response() -> None:
    log = _log(0.5, 0.1)
    nothing = {name: getattr(log, name)[:0] for name in ("setpoint_time_s", "setpoint_velocity", "setpoint_height_m")}
    assert velocity_response(AutopilotLog(**{**log.__dict__, **nothing})) is None
