"""Networks that are whole, one that is not, and steps that take too long."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockd.core.config.drone import DroneConfig
from flockd.core.config.perception import PerceptionConfig
from flockd.core.messages import PilotOutput
from flockd.ground.doctor import Level
from flockd.ground.doctor.model_checks import STEPS, check_models, judge_steps, meadow, time_steps
from tests import make
from tests.flight.inference.conftest import copies
from tests.onboard.daemon.aboard import TinyPerceiver

__all__ = ["copies"]

TINY = make.drone()


def _with(**perception: object) -> DroneConfig:
    return TINY.model_copy(update={"perception": PerceptionConfig.model_validate({"threads": 1, **perception})})


def test_a_flipped_bit_is_a_failure_of_that_model_alone(copies: Path) -> None:
    content = bytearray((copies / "distance_int8.onnx").read_bytes())
    content[len(content) // 2] ^= 1
    (copies / "distance_int8.onnx").write_bytes(content)
    found = {finding.about: finding for finding in check_models(_with(models_dir=str(copies)))}
    names = ("flow_int8", "neighbours_int8", "detector", "distance_int8", "verification_int8")
    assert list(found) == [f"model {name}" for name in names]
    failed = [about for about, finding in found.items() if finding.level is not Level.PASS]
    assert failed == ["model distance_int8"]
    assert "was changed or damaged" in found["model distance_int8"].measured


def test_whole_steps_are_timed_and_the_pilot_sees_its_way() -> None:
    first, second = meadow((64, 48), 0), meadow((64, 48), 1)
    assert (first[24:, 4:] == second[24:, :-4]).all(), "the grass passes by"
    timed = time_steps(TINY, TinyPerceiver())
    assert len(timed) == STEPS
    assert all(seconds > 0.0 for seconds, _ in timed)
    assert timed[-1][1].stages_ms.keys() >= {"scene", "flow", "detection"}


def _timed(seconds: float) -> list[tuple[float, PilotOutput]]:
    output = time_steps(TINY, TinyPerceiver())[-1][1]
    return [(99.0, output), *[(seconds, output)] * 3]


@pytest.mark.parametrize(
    ("seconds", "level"), [(0.2, Level.PASS), (0.39, Level.PASS), (0.45, Level.WARNING), (0.55, Level.FAILURE)]
)
def test_the_first_step_warms_up_and_the_others_have_half_a_second(seconds: float, level: Level) -> None:
    assert TINY.step_s == 0.5
    finding = judge_steps(TINY, _timed(seconds), busy=0.5, cores=2)
    assert (finding.level, finding.about) == (level, "step")
    assert f"a step takes {1e3 * seconds:.0f} of 500 ms with 2 threads and 1 camera" in finding.measured
    assert judge_steps(TINY, _timed(0.7), busy=9.0, cores=2).fix.startswith("stop other programs first")
