"""`flockd config new` writes files that check, and nothing over what is there."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config import load_drone, load_real_drone
from flockd.core.data import data_path
from flockd.sim.scenario import load_scenario


def new(kind: str, file: Path, *settings: str) -> int:
    return main(["config", "new", kind, str(file), *(word for setting in settings for word in ("--set", setting))])


def test_a_new_scenario_checks_and_keeps_what_was_set(tmp_path: Path) -> None:
    file = tmp_path / "woods.yaml"
    settings = ("duration_s=30", "mission={kind: hover}", "world.obstacles.kind=forest", "obstacles.enabled=true")
    assert new("scenario", file, *settings) == 0
    scenario = load_scenario(file)
    assert (scenario.scenario, scenario.duration_s, len(scenario.vehicles)) == ("woods", 30.0, 5)
    assert scenario.drone.mission.kind == "hover"
    assert scenario.world.obstacles is not None
    assert (scenario.world.obstacles.kind, scenario.drone.obstacles.enabled) == ("forest", True)
    assert "# of the world and of all noise" in file.read_text(encoding="utf-8"), "comments stay"


def test_a_new_drone_has_cameras_on_their_sides_evenly_around(tmp_path: Path) -> None:
    file = tmp_path / "kite.yaml"
    assert new("drone", file, "name=kite", "autopilot.address=serial:///dev/ttyAMA0:57600", "telemetry.fleet=ours") == 0
    drone = load_drone(file)
    assert [camera.extrinsics.yaw_deg for camera in drone.rig.cameras] == [0.0, 90.0, 180.0, 270.0]
    # 320 px at 65 degrees of an equidistant lens, along the longer side: r = f theta.
    assert drone.rig.cameras[0].intrinsics.fx == pytest.approx(320 / 1.1344640, abs=0.05)
    assert drone.source is not None
    assert {camera.turn_deg for camera in drone.source.cameras} == {90}
    assert drone.autopilot is not None
    assert (drone.name, drone.autopilot.address) == ("kite", "serial:///dev/ttyAMA0:57600")
    assert drone.telemetry.fleet == "ours"


@pytest.mark.parametrize("shipped", [True, False], ids=["shipped", "new"])
def test_a_real_drone_hovers_at_a_metre_per_second_at_most_until_its_owner_says_otherwise(
    shipped: bool, tmp_path: Path
) -> None:
    file = tmp_path / "new.yaml"
    assert new("drone", file) == 0
    drone = load_drone(data_path("config") / "quadrotor.yaml" if shipped else file)
    assert drone.mission.kind == "hover"
    assert drone.flocking.max_speed_m_s <= 1.0


def test_new_drones_of_a_flock_begin_with_first_flights_each_in_its_layer(tmp_path: Path) -> None:
    heights = []
    for number in ("1", "2", "9"):
        file = tmp_path / f"{number}.yaml"
        assert new("drone", file, f"safety.first_flight_layer={number}", "safety.gate.max_height_m=40") == 0
        drone, outside = load_real_drone(file)
        assert not outside
        assert drone.flocking.max_speed_m_s <= 1.0
        heights.append(drone.mission.height_m)
    assert heights == [3.0, 7.0, 35.0]
    assert load_real_drone(data_path("config") / "quadrotor.yaml")[0].mission.height_m == 3.0


def test_a_new_drones_devices_have_to_be_filled_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new.yaml"
    assert new("drone", file) == 0
    assert main(["config", "check", str(file)]) == 78
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 4
    assert "source.cameras[0].device: is yet to be filled in (CHANGE-ME); `flockd cameras --write FILE`" in told[0]
    file.write_text(file.read_text(encoding="utf-8").replace("CHANGE-ME", "usb"), encoding="utf-8")
    assert main(["config", "check", str(file)]) == 0
    guessed = f"warning: {file}: cameras front, right, back, left: their lenses are not calibrated"
    assert capsys.readouterr().err.startswith(guessed)


def test_nothing_is_overwritten_without_force_nor_written_that_does_not_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mine", encoding="utf-8")
    assert new("drone", file) == 2
    assert "exists; name another file, or overwrite it with --force" in capsys.readouterr().err
    assert main(["config", "new", "drone", str(file), "--force", "--set", "autopilot.address=nowhere"]) == 2
    told = capsys.readouterr().err
    assert "mine.yaml was not written, as it would not check (autopilot.address: " in told
    assert main(["config", "new", "drone", str(file), "--force", "--set", "rig.cameras={"]) == 2
    capsys.readouterr()
    assert main(["config", "new", "drone", str(file), "--force", "--set", "rig.cameras.0.name=nose"]) == 2
    assert "rig.cameras is a list, whose entries cannot be set one by one; write all of it" in capsys.readouterr().err
    assert main(["config", "new", "drone", str(tmp_path), "--force"]) == 2
    assert capsys.readouterr().err == f"{tmp_path}: is a folder; name a file in it\n"
    assert file.read_text(encoding="utf-8") == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]
    assert main(["config", "new", "drone", str(file), "--force"]) == 0
    assert load_drone(file).name == "drone1"
