"""`flockd config new` writes files that check, and nothing over what is there."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config import load_drone, load_real_drone, load_scenario
from flockd.core.data import data_path


def test_a_scenario_of_each_mission_checks_and_keeps_its_drones_apart(tmp_path: Path) -> None:
    for drones, mission in ((1, "hover"), (2, "velocity"), (5, "waypoints"), (12, "follow"), (100, "operator")):
        file = tmp_path / f"{mission}.yaml"
        options = ["--drones", f"{drones}", "--mission", mission, "--duration", "30", "--defaults"]
        assert main(["config", "new", "scenario", str(file), *options]) == 0
        scenario = load_scenario(file)
        assert (scenario.scenario, scenario.duration_s, len(scenario.vehicles)) == (mission, 30.0, drones)
        assert scenario.drone.mission.kind == mission
        assert len(scenario.drone.rig.cameras) == 4


def test_a_drone_has_its_cameras_evenly_around(tmp_path: Path) -> None:
    file = tmp_path / "kite.yaml"
    options = ["--name", "kite", "--cameras", "3", "--size", "1280x720", "--field-of-view", "90", "--mission", "follow"]
    assert main(["config", "new", "drone", str(file), *options, "--defaults"]) == 0
    drone = load_drone(file)
    assert [camera.extrinsics.yaw_deg for camera in drone.rig.cameras] == [0.0, 120.0, 240.0]
    # 640 px at 45 degrees of an equidistant lens: r = f theta.
    assert drone.rig.cameras[0].intrinsics.fx == pytest.approx(640 / 0.7853982, abs=0.05)
    assert (drone.name, drone.mission.kind) == ("kite", "follow")


@pytest.mark.parametrize(("size", "turn_deg"), [("480x640", 90), ("640x480", 0)])
def test_images_that_are_higher_than_wide_are_of_cameras_on_their_sides(
    tmp_path: Path, size: str, turn_deg: int
) -> None:
    usb, other = tmp_path / "usb.yaml", tmp_path / "other.yaml"
    assert main(["config", "new", "drone", str(usb), "--size", size, "--defaults"]) == 0
    drone = load_drone(usb)
    assert drone.source is not None
    assert {camera.turn_deg for camera in drone.source.cameras} == {turn_deg}
    # 320 px at 65 degrees of an equidistant lens, along the longer side: r = f theta.
    assert drone.rig.cameras[0].intrinsics.fx == pytest.approx(320 / 1.1344640, abs=0.05)
    assert main(["config", "new", "drone", str(other), "--size", size, "--source", "gstreamer", "--defaults"]) == 0
    pipelines = load_drone(other).source
    assert pipelines is not None
    assert all(("flip-method=3" in (camera.pipeline or "")) is (turn_deg == 90) for camera in pipelines.cameras)


@pytest.mark.parametrize("shipped", [True, False], ids=["shipped", "new"])
def test_a_real_drone_hovers_at_a_metre_per_second_at_most_until_its_owner_says_otherwise(
    shipped: bool, tmp_path: Path
) -> None:
    new = tmp_path / "new.yaml"
    assert main(["config", "new", "drone", str(new), "--defaults"]) == 0
    drone = load_drone(data_path("config") / "quadrotor.yaml" if shipped else new)
    assert drone.mission.kind == "hover"
    assert drone.flocking.max_speed_m_s <= 1.0


def test_new_drones_of_a_flock_begin_with_first_flights_each_in_its_layer(tmp_path: Path) -> None:
    heights = []
    for number in ("1", "2", "9"):
        file = tmp_path / f"{number}.yaml"
        assert main(["config", "new", "drone", str(file), "--number", number, "--defaults"]) == 0
        drone, outside = load_real_drone(file)
        assert not outside
        assert drone.flocking.max_speed_m_s <= 1.0
        heights.append(drone.mission.height_m)
    assert heights == [3.0, 7.0, 35.0]
    assert load_real_drone(data_path("config") / "quadrotor.yaml")[0].mission.height_m == 3.0


@pytest.mark.parametrize("source", ["v4l2", "gstreamer", "ros", "shared_memory"])
def test_a_drones_frames_come_from_where_is_asked(tmp_path: Path, source: str) -> None:
    file = tmp_path / "kite.yaml"
    assert main(["config", "new", "drone", str(file), "--cameras", "2", "--source", source, "--defaults"]) == 0
    written = load_drone(file).source
    assert written is not None
    assert written.kind == source
    assert [camera.name for camera in written.cameras] == ([] if source == "shared_memory" else ["front", "back"])


def test_on_a_terminal_it_asks_until_the_answer_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter(["", "a hundred", "3", "", "waypoints", "", ""])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    file = tmp_path / "asked.yaml"
    assert main(["config", "new", "scenario", str(file)]) == 0
    assert len(load_scenario(file).vehicles) == 3
    assert next(answers, None) is None


def test_an_answer_that_the_file_could_not_have_is_asked_for_again_and_no_other_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = iter(["my drone", "kite", "2", "", "", "", "", "/dev/ttyAMA0", "serial:///dev/ttyAMA0:57600", "", ""])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    file = tmp_path / "asked.yaml"
    assert main(["config", "new", "drone", str(file)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "'my drone' is not a name; write my_drone"
    assert told[1].startswith("'/dev/ttyAMA0' is not an address; write an address, as in `serial:///dev/ttyAMA0:")
    drone = load_drone(file)
    assert (drone.name, drone.safety.first_flight_layer) == ("kite", 2)
    assert drone.autopilot is not None
    assert drone.autopilot.address == "serial:///dev/ttyAMA0:57600"
    assert next(answers, None) is None


def test_a_new_drones_devices_have_to_be_filled_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new.yaml"
    assert main(["config", "new", "drone", str(file), "--cameras", "2", "--defaults"]) == 0
    assert main(["config", "check", str(file)]) == 78
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2
    assert "source.cameras[0].device: is yet to be filled in (CHANGE-ME); `flockd cameras --write FILE`" in told[0]
    file.write_text(file.read_text(encoding="utf-8").replace("CHANGE-ME", "usb"), encoding="utf-8")
    assert main(["config", "check", str(file)]) == 0


def test_nothing_is_overwritten_without_force_nor_written_that_does_not_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mine", encoding="utf-8")
    assert main(["config", "new", "drone", str(file), "--defaults"]) == 2
    assert "exists; name another file, or overwrite it with --force" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["config", "new", "drone", str(file), "--defaults", "--force", "--autopilot", "nowhere"])
    assert "argument --autopilot: 'nowhere' is not an address; write an address, as in" in capsys.readouterr().err
    assert file.read_text(encoding="utf-8") == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]
    assert main(["config", "new", "drone", str(file), "--defaults", "--force"]) == 0
    assert load_drone(file).name == "drone1"
