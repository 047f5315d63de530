"""The mode that PX4 itself ends in after faults, beside what its parameters promise; and the tool without PX4."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from flockd.core.config.scenario import ScenarioConfig
from flockd.sim.autopilots import SimulatedAutopilots
from tools.checks.px4_modes import FAULTS, Fault, Result, _line, run

PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")


@PX4
@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_px4_ends_in_the_mode_that_its_parameters_promise(fault: Fault) -> None:
    (result,) = run([fault], 1.0, lambda result: None)
    assert result.kept, result
    if fault.name == "wind":
        assert result.drift_m_s < 0.5


@pytest.mark.parametrize("tool", ["px4_missions", "px4_modes", "px4_reasons"])
def test_without_px4_a_tool_says_what_to_do(
    tool: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FLOCKD_PX4", str(tmp_path))
    monkeypatch.setattr("sys.argv", [tool])
    assert import_module(f"tools.checks.{tool}").main() == 69
    assert f"there is no PX4 in {tmp_path}, which FLOCKD_PX4 names; set it to" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "speed_factor"), [("sender_killed", 2.0), pytest.param("daemon_killed", 1.0, marks=pytest.mark.slow)]
)
def test_a_killed_companion_ends_a_fake_autopilots_offboard_flight_in_hold(
    name: str, speed_factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole of a trial, with a fake autopilot in PX4's place: it goes from offboard to Hold afterwards."""
    monkeypatch.setattr("tools.checks.px4_modes.Px4s", _Fake)
    (killed,) = [fault for fault in FAULTS if fault.name == name]
    (result,) = run([killed], speed_factor, lambda result: None)
    assert result.modes == ("OFFBOARD", "LOITER"), result
    assert result.kept
    assert result.reaction_s is not None
    assert result.reaction_s > 0.0


class _Fake(SimulatedAutopilots):
    """Fake autopilots that are made as PX4s are."""

    def __init__(self, scenario: ScenarioConfig, speed_factor: float, *_: object) -> None:
        super().__init__(scenario, speed_factor, lambda north, _: np.zeros_like(north))


def test_a_mode_that_was_not_promised_is_shown_as_such() -> None:
    result = Result("link_lost", "LOITER", "COM_OBL_RC_ACT 5: Hold", "RTL", 1.26, ("OFFBOARD", "LOITER", "RTL"), 0.104)
    assert not result.kept
    line = _line(result)
    assert "RTL after 1.3 s" in line
    assert "NOT AS PROMISED" in line
    assert "OFFBOARD > LOITER > RTL; COM_OBL_RC_ACT 5: Hold; velocity off by 0.10 m/s" in line
