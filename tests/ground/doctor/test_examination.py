"""An examination ends, whatever its checks do, and says what became of each."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.ground.doctor import CHECKS, Check, Finding, Level, passed, run_checks
from flockd.onboard.autopilot.link_owner import only_owner

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
        (
            ModelError("a.yaml: sha256: changed; and more; restore it"),
            "a.yaml: sha256: changed; and more",
            "restore it",
        ),
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
