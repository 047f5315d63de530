"""What is wrong at the start is refused in one sentence, by the command as a person or systemd runs it."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.sim.sitl.ports import free_endpoint, free_port
from tests.faults.process import flying
from tests.faults.stories import Reacted
from tests.onboard.daemon.aboard import config_for

pytestmark = pytest.mark.slow
RUN = "from flockd.cli import program; program()"
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Ended:
    code: int
    took_s: float
    last: str
    """The last line of what it said."""


def _run(folder: Path, change: Callable[[dict[str, Any]], object]) -> Ended:
    """`flockd run` with a configuration that was spoiled."""
    config = config_for(free_port(), free_endpoint(), free_endpoint())
    values = config.model_dump(mode="json", exclude_defaults=True)
    change(values)
    path = folder / "drone.yaml"
    path.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    began_s = time.monotonic()
    ended = subprocess.run(
        [sys.executable, "-c", RUN, "run", "--config", str(path)], cwd=ROOT, capture_output=True, text=True,
        check=False, timeout=60.0,
    )  # fmt: skip
    assert "Traceback" not in ended.stderr
    return Ended(ended.returncode, time.monotonic() - began_s, ended.stderr.strip().splitlines()[-1])


@pytest.mark.fault("wrong-configuration", within_s=30.0)
@pytest.mark.fault("absurd-limits")
@pytest.mark.parametrize(
    ("section", "key", "value", "told"),
    [
        ("autopilot", "adress", "udpin://x", "autopilot.adress: is not a known key; did you mean `address`?"),
        ("autopilot", "arm_and_take_off", False, "a pilot or a ground station arms, takes off and selects offboard"),
        ("safety", "hover_s", 1e9, "safety.hover_s: 1000000000.0 is not at most 3; write "),
        ("safety", "heartbeat_timeout_s", "2 s", "safety.heartbeat_timeout_s: 2 s is not a number"),
        ("perception", "deadline_s", 1e9, "perception.deadline_s: 1000000000.0 is not "),
    ],
)
def test_the_configuration_is_wrong(
    section: str, key: str, value: object, told: str, tmp_path: Path, reacted: Reacted
) -> None:
    ended = _run(tmp_path, lambda values: values.setdefault(section, {}).update({key: value}))
    assert ended.code == 78
    assert told in ended.last
    assert ended.last.startswith(f"{tmp_path / 'drone.yaml'}:")
    reacted("wrong-configuration", ended.took_s)


@pytest.mark.fault("second-instance", within_s=15.0)
async def test_a_second_instance_is_started_in_flight(tmp_path: Path, reacted: Reacted) -> None:
    async with flying(tmp_path) as process:
        began_s = time.monotonic()
        first = process.program
        process.daemons.start()
        assert await process.ended() == 69
        reacted("second-instance", time.monotonic() - began_s)
        assert f"another flockd (process {first.process.pid} of user " in process.log()
        await process.steps_on()
        assert process.fake_autopilot.mode == "OFFBOARD"
        assert first.ended is None
