"""An examination ends, whatever its checks do, and says what became of each."""

from __future__ import annotations

import json
import re
import shutil
import statistics
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.data import data_path
from flockd.core.errors import ModelError, UnavailableError
from flockd.ground.doctor import CHECKS, Check, Finding, Level, passed, run_checks
from flockd.onboard.autopilot.link_owner import only_owner
from flockd.onboard.recording.reader import Recording
from flockd.sim.scenario import ScenarioConfig

FLIGHT = Path(__file__).parents[2] / "review" / "replay" / "crossing.mcap"
QUADROTOR = str(data_path("config") / "quadrotor.yaml")


def _examined(check: Check) -> tuple[Finding, ...]:
    told: list[tuple[int, int]] = []
    found = run_checks([check], lambda done, total: told.append((done, total)))
    assert told == [(1, 1)]
    return found[check.name]


def test_a_check_that_hangs_is_a_failure_and_what_it_found_before_counts() -> None:
    for_ever = threading.Event()

    def hangs() -> Iterator[Finding]:
        yield passed("camera front", "fine")
        for_ever.wait()
        yield passed("camera back", "too late")

    first, late = _examined(Check("cameras", hangs, limit_s=0.2))
    for_ever.set()
    assert (first.level, first.about) == (Level.PASS, "camera front")
    assert (late.level, late.about) == (Level.FAILURE, "cameras")
    assert "0.2 s" in late.measured
    assert late.fix


@pytest.mark.parametrize(
    ("error", "measured", "fix"),
    [
        (ModelError("a.yaml: sha256: off; and more; restore it"), "a.yaml: sha256: off; and more", "restore it"),
        (ModelError("all is lost"), "all is lost", "correct it"),
        (OSError(5, "Input/output error", "/dev/x"), "/dev/x: Input/output error", "check that it responds"),
        (ImportError("libmavsdk.so is not there"), "libmavsdk.so is not there", "install flockd again"),
        (ArithmeticError("1 / 0"), "ArithmeticError('1 / 0')", "report it"),
    ],
)
def test_an_error_is_reported_with_its_fix_and_the_other_checks_run(error: Exception, measured: str, fix: str) -> None:
    def breaks() -> Iterator[Finding]:
        raise error
        yield

    fine = passed("disk", "fine")
    found = run_checks([Check("x", breaks, 5.0), Check("disk", lambda: [fine], 5.0)], lambda done, total: None)
    (broken,) = found["x"]
    assert (broken.level, broken.about) == (Level.FAILURE, "x")
    assert measured in broken.measured
    assert broken.fix.startswith(fix)
    assert found["disk"] == (fine,)


def test_json_for_machines_and_exit_code_1_when_a_check_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["doctor", "--config", QUADROTOR, "--only", "disk", "--only", "memory", "--json"]
    assert main([*command, "--record", str(tmp_path / "none")]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["drone"], told["ok"]) == ("drone1", False)
    memory, disk = told["findings"]
    assert (memory["check"], memory["level"], memory["mend"]) == ("memory", "PASS", None)
    assert (disk["check"], disk["about"], disk["level"]) == ("disk", "disk", "FAILURE")
    assert disk["mend"].startswith("make the folder")
    assert main(["doctor", "--config", QUADROTOR, "--only", "memory", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] is True
    assert main([*command[:-1], "--record", str(tmp_path / "none")]) == 1
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert lines[0].startswith("FAILURE  disk"), "people see the worst first, with what to do"
    assert any(line.startswith("fix: make the folder") for line in lines)
    assert re.findall(r" \d", lines[-1]) == [" 1", " 0", " 1"]


TOUCHING = ["rig", "zenoh", "autopilot", "cameras", "models"]
"""They open what the drone flies with, or take its computer's time for long."""


@pytest.mark.fault("serial-port")
def test_beside_a_flying_daemon_nothing_of_the_drone_is_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def touched(*_: object) -> Iterator[Finding]:
        raise AssertionError("the drone was touched")
        yield

    for check in (
        "camera_checks.check_rig",
        "setup_checks.check_fleet",
        "autopilot_checks.check_autopilot",
        "camera_checks.check_cameras",
        "model_checks.check_models",
    ):
        monkeypatch.setattr(f"flockd.ground.doctor.{check}", touched)
    address = f"serial://{tmp_path / 'ttyUSB0'}:921600"
    shipped = (data_path("config") / "quadrotor.yaml").read_text(encoding="utf-8")
    (tmp_path / "drone.yaml").write_text(shipped.replace("serial:///dev/ttyAMA0:921600", address), encoding="utf-8")
    with only_owner(AutopilotParameters(address=address)):
        assert main(["doctor", "--config", str(tmp_path / "drone.yaml"), "--record", str(tmp_path), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)["findings"]
    assert [row["check"] for row in told if row["measured"].startswith("not examined: another flockd has")] == TOUCHING
    assert {row["level"] for row in told if row["check"] in TOUCHING} == {"WARNING"}
    (instance,) = (row for row in told if row["check"] == "instance")
    assert instance["level"] == "FAILURE"
    assert instance["measured"].endswith(f"has the link {address}")
    assert "touched" not in str(told)


def test_the_documentation_names_every_check() -> None:
    page = (Path(__file__).parents[3] / "docs" / "real_drone.md").read_text(encoding="utf-8")
    section = page[page.index("## 3. Check the drone on the ground") :]
    for name in CHECKS:
        assert f"`{name}`" in section[: section.index("\n## ")], name


MADE_UP = "autopilot and images are made up: this examines the computer, and no camera, autopilot or drone"


@pytest.mark.parametrize(
    ("handed_over", "exit_code", "level", "told"),
    [
        ({}, 0, "PASS", "flew 15 s in offboard; of 10 steps 8 saw the drone beside it"),
        ({"drone1": "after 3.1 s it left offboard"}, 0, "FAILURE", "did not fly to the end: after 3.1 s it left offb"),
        ({}, 70, "FAILURE", "did not fly to the end: exit code 70"),
    ],
)
def test_the_bench_of_a_demo_tells_what_is_made_up_and_how_long_its_steps_took(
    handed_over: dict[str, str], exit_code: int, level: str, told: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Its flight is one of those that are recorded: 10 steps."""

    def fly(scenario: ScenarioConfig, sitl: DroneConfig, *, recordings: Path, **rest: Any) -> Any:
        assert (rest["kind"], rest["speed_factor"], scenario.duration_s) == ("fake", 1.0, 15.0)
        shutil.copy(FLIGHT, recordings / "drone1-0.mcap")
        fleet = SimpleNamespace(handed_over=handed_over, exit_codes={"drone1": exit_code})
        return SimpleNamespace(log=SimpleNamespace(metadata=SimpleNamespace(fleet=fleet)))

    monkeypatch.setattr("flockd.sim.sitl.fleet.fly_fleet", fly)
    code = main(["doctor", "--bench", "--demo", "--json"])
    findings = {one["about"]: one for one in json.loads(capsys.readouterr().out)["findings"]}
    assert code == (0 if level == "PASS" else 1)
    assert (findings["made up"]["level"], findings["made up"]["measured"]) == ("WARNING", MADE_UP)
    assert findings["daemon"]["level"] == level
    assert findings["daemon"]["measured"].startswith(told)
    recorded = [step.output for step in Recording(FLIGHT).steps() if step.output]
    assert sum(any(one["confirmed"] for one in output["neighbours"]) for output in recorded) == 8
    took_ms = statistics.median(sum(output["stages_ms"].values()) for output in recorded[1:])
    assert f"a step takes {took_ms:.0f} of 500 ms" in findings["step"]["measured"]


def test_a_computer_too_slow_to_fly_the_bench_fails_it_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    late = "drone1 had no flockd that was ready to fly it within 60 s (flockd: a step takes 284% of the step time)"

    def fly(*_: object, **__: object) -> None:
        raise UnavailableError(late)

    monkeypatch.setattr("flockd.sim.sitl.fleet.fly_fleet", fly)
    assert main(["doctor", "--bench", "--demo", "--json"]) == 1
    _, daemon = json.loads(capsys.readouterr().out)["findings"]
    assert (daemon["about"], daemon["level"], daemon["measured"]) == ("daemon", "FAILURE", late)
    for remedy in ("stop other programs", "perception.threads", "step_s", "smaller images"):
        assert remedy in daemon["mend"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], "--config is missing; name the drone's file, or try `flockd doctor --bench --demo`"),
        (["--bench", "--config", QUADROTOR], "for the bench of a drone, run `flockd run` with propellers off, and"),
        (["--demo"], "--bench and --demo go together; add the other one"),
        (["--bench", "--demo", "--only", "rig"], "--only has no meaning with --demo; drop it"),
    ],
)
def test_options_that_do_not_go_together(options: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", *options]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.whole_flight
def test_the_bench_of_a_demo_flies_with_nothing_attached(capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever the computer's speed: the daemon comes up, takes off, steps and ends."""
    main(["doctor", "--bench", "--demo", "--seconds", "8"])
    told = capsys.readouterr()
    assert MADE_UP in told.out
    assert MADE_UP in told.err
    assert re.search(r"a step takes \d+ of 500 ms with 1 thread and 4 cameras", told.out)
