"""Scenario files: read, or refused at their line, with the drone's file beside them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from flockd.campaign.campaign_file import load_campaign
from flockd.cli import main
from flockd.core.config import DroneConfig, Overrides, load_drone
from flockd.core.errors import ConfigError
from flockd.flight.geometry import build_rig
from flockd.sim.scenario import load_scenario, load_with_places, scenario_schema
from tests.core.config.test_loader import CONFIG, DRONE, places_of, problems_in, with_line
from tests.hostile import CORPUS, hostile, own_errors, put, text_of

SCENARIO = """\
scenario: two
drone: drone.yaml
vehicles:
  - {position_m: [0, 0, -4]}
  - {position_m: [0, 5, -4]}
"""


def test_the_papers_flight_is_table_1() -> None:
    scenario = load_scenario(CONFIG / "paper_flight.yaml")
    table_1 = [(-0.5, 0.9, -4.5), (0.5, -2.8, -4.0), (1.2, 4.5, -5.0), (3.9, 0.5, -3.5), (4.5, 1.4, -3.0)]
    assert [vehicle.position_m for vehicle in scenario.vehicles] == table_1
    assert {vehicle.velocity_m_s for vehicle in scenario.vehicles} == {(1.0, 0.0)}
    assert scenario.duration_s == 110.0
    assert scenario.drone.step_s == 0.5
    assert scenario.drone.flocking.desired_distance_m == 3.5


@pytest.mark.fault("wrong-configuration")
def test_all_problems_of_both_files_come_at_once(tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(with_line("stepp_s: 0.5\nyaw: corse"), encoding="utf-8")
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(SCENARIO.replace("[0, 5, -4]", "[0, 5]") + "duration_s: 0\n", encoding="utf-8")
    assert places_of(problems_in(scenario, load_scenario)) == [
        *("drone.yaml:6: stepp_s", "drone.yaml:7: yaw"),
        *("scenario.yaml:5: vehicles[1].position_m", "scenario.yaml:6: duration_s"),
    ]


def test_a_scenario_without_its_drones_file_has_one_fault_and_no_false_ones(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    for text in (SCENARIO, (CONFIG / "square.yaml").read_text(encoding="utf-8").replace("simulator.", "drone.")):
        scenario.write_text(text, encoding="utf-8")
        missing, named = problems_in(scenario, load_scenario)
        assert (missing.file, missing.key) == ("drone.yaml", "")
        assert (named.file, named.key) == ("scenario.yaml", "drone")
    scenario.write_text(SCENARIO.replace("drone: drone.yaml\n", ""), encoding="utf-8")
    assert places_of(problems_in(scenario, load_scenario)) == ["scenario.yaml:1: drone"]


def test_overrides_win_over_both_files() -> None:
    overrides: Overrides = {"seed": 7, "drone.perception.flow": "dis", "drone.flocking.weight.kind": "nearest"}
    scenario = load_scenario(CONFIG / "paper_flight.yaml", overrides)
    assert scenario.seed == 7
    assert scenario.drone.perception.flow == "dis"
    assert scenario.drone.perception.depth == "neighbours_int8", "the rest of the section stays"
    assert scenario.drone.flocking.weight.kind == "nearest"


@pytest.mark.parametrize("key", ["vehicles.0.position_m", "drone.rig.cameras.front.extrinsics"])
def test_an_override_of_an_entry_of_a_list_is_refused_and_not_left_out(key: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_scenario(CONFIG / "paper_flight.yaml", {key: (0.0, 0.0, -3.0)})
    (problem,) = refused.value.problems
    assert (problem.file, problem.key) == ("override", key)
    assert problem.message.endswith(" is a list, whose entries cannot be set one by one; write all of it")


def test_a_wrong_override_is_reported_as_such() -> None:
    with pytest.raises(ConfigError) as caught:
        load_scenario(CONFIG / "paper_flight.yaml", {"duration_s": -3.0, "drone.perception.sclae": "height"})
    assert [(one.file, one.line, one.key) for one in caught.value.problems] == [
        ("override", 0, "drone.perception.sclae"),
        ("override", 0, "duration_s"),
    ]


def test_the_schema_describes_the_file_and_not_the_merged_model() -> None:
    drone = scenario_schema()["properties"]["drone"]
    assert drone["anyOf"] == [{"type": "string"}, {"$ref": "#/$defs/DroneConfig"}], "a path, or the drone itself"
    assert DroneConfig.model_json_schema()["required"] == ["rig"]


FLIGHTS = (
    ("[0, 0, -4]", "[0, 0, 4.5]", "4: vehicles[0].position_m: the third number points down"),
    ("[0, 0, -4]", "[0, 0, -0.2]", "4: vehicles[0].position_m: begins 0.2 m above the ground"),
    ("[0, 5, -4]", "[0, 0, -4]", "5: vehicles[1].position_m: is 0 m from vehicles[0]"),
    ("", "faults: [{drone: 3, camera: front}]", "2: faults[0].drone: is 3, but there are 2"),
    ("", "faults: [{drone: 1, camera: top}]", "2: faults[0].camera: is not in the rig"),
    ("", "faults: [{drone: 1, camera: front, begin_s: 5, end_s: 4}]", "2: faults[0].end_s: is not after begin_s 5"),
    (
        "- {position_m: [0, 5, -4]}",
        "- {position_m: [0, 5, -4], by_hand: true}\nfaults: [{drone: 2, camera: front}]",
        "6: faults[0].drone: is 2, which is flown by hand; write one of flockd's",
    ),
    ("", "sensors: {range_finder: {min_m: 30}}", "2: sensors.range_finder.min_m: 30 is not below max_m 20; write a"),
    ("", "detections: {false_m: [20, 10, 5]}", "2: detections.false_m: falls; write the 10th, the 50th and the 90th"),
    ("", "world: {drone_family: 99}", "2: world.drone_family: 99 is not at most 13; write a whole number from 0 to"),
    ("", "world:\n  obstacles:\n    kind: jungle", "4: world.obstacles.kind: jungle is not known; write `forest` or"),
    ("", "world: {obstacles: {trees_per_hectare: 99, kind: village}}", "2: world.obstacles.trees_per_hectare: has no"),
    ("", "duration_s: 0.1", "2: duration_s: 0.1 s is shorter than a step of 0.5 s"),
)


@pytest.mark.parametrize(("old", "new", "told"), FLIGHTS, ids=[told for *_, told in FLIGHTS])
def test_a_flight_that_cannot_be_flown_is_refused_at_its_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    scenario = tmp_path / "scenario.yaml"
    text = SCENARIO.replace(old, new) if old else SCENARIO.replace("scenario: two", f"scenario: two\n{new}")
    scenario.write_text(text, encoding="utf-8")
    (problem,) = problems_in(scenario, load_scenario)
    assert str(problem).startswith(f"scenario.yaml:{told}")


def test_drones_out_of_sight_and_faults_after_the_end_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The third is 500 m away; 60 m is `perception.detection.max_range_m`."""
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    (scenario := tmp_path / "two.yaml").write_text(SCENARIO, encoding="utf-8")
    assert main(["config", "check", str(scenario)]) == 0
    assert not capsys.readouterr().err
    late = "faults: [{drone: 1, camera: front, begin_s: 110}]\ntakeovers: [{drone: 1, time_s: 200, to: hold}]\n"
    scenario.write_text(SCENARIO + late, encoding="utf-8")
    assert main(["config", "check", str(scenario)]) == 0
    told = [line.partition(": ")[2].removeprefix(f"{scenario}: ") for line in capsys.readouterr().err.splitlines()]
    after = "is not before the flight's end, duration_s 110: it will not happen; write an earlier one"
    assert told == [f"faults[0].begin_s: 110 {after}", f"takeovers[0].time_s: 200 {after}"]
    scenario.write_text(SCENARIO + "  - {position_m: [400, 305, -4]}\n", encoding="utf-8")
    assert main(["config", "check", str(scenario)]) == 0
    (warned,) = capsys.readouterr().err.splitlines()
    assert warned.startswith(f"warning: {scenario}: vehicles[2].position_m: begins 500 m from the nearest other, ")
    assert "perception.detection.max_range_m, 60 m" in warned


def test_files_of_another_kind_are_refused_with_what_to_name(tmp_path: Path) -> None:
    campaign, scenario, drone = CONFIG / "campaigns" / "nightly.yaml", CONFIG / "square.yaml", CONFIG / "quadrotor.yaml"
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    (flight := tmp_path / "flight.yaml").write_text(SCENARIO, encoding="utf-8")
    (nested := tmp_path / "scenario.yaml").write_text(SCENARIO.replace("drone.yaml", "flight.yaml"), encoding="utf-8")
    refusals: tuple[tuple[Callable[[Path], object], Path, str, str], ...] = (
        (load_drone, campaign, "is a campaign", "`flockd campaign`"),
        (load_scenario, campaign, "is a campaign", "`flockd campaign`"),
        (load_campaign, scenario, "is a scenario", "the keys `campaign` and `scenario`"),
        (load_campaign, drone, "is a drone's own file", "the keys `campaign` and `scenario`"),
        (load_drone, flight, "is a scenario", "name that: drone.yaml"),
        (load_scenario, drone, "is a drone's own file", "the keys `vehicles` and `drone`"),
        (load_scenario, nested, "is a scenario", "name that: drone.yaml"),
    )
    for load_file, file, kind, instead in refusals:
        with pytest.raises(ConfigError) as refused:
            load_file(file)
        told = str(refused.value).splitlines()[0].replace(f"{tmp_path}/", "")
        assert kind in told
        assert instead in told


def test_a_scenario_may_hold_its_drone(tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    (tmp_path / "named.yaml").write_text(SCENARIO, encoding="utf-8")
    inline = "drone:\n" + "".join(f"  {line}\n" for line in DRONE.splitlines())
    (tmp_path / "held.yaml").write_text(SCENARIO.replace("drone: drone.yaml\n", inline), encoding="utf-8")
    assert load_scenario(tmp_path / "held.yaml") == load_scenario(tmp_path / "named.yaml")
    file = tmp_path / "scenario.yaml"
    file.write_text(SCENARIO.replace("drone: drone.yaml\n", inline.replace("cx: 320", "cx: -1")), encoding="utf-8")
    (place,) = places_of(problems_in(file, load_scenario))
    assert place == "scenario.yaml:7: drone.rig.cameras[0].intrinsics.cx"


def test_a_changed_configuration_is_read_or_refused(tmp_path: Path) -> None:
    shutil.copytree(CONFIG, tmp_path, dirs_exist_ok=True)
    small = [path.read_text(encoding="utf-8") for path in sorted(CORPUS.glob("*.yaml"))]
    shipped = [path.read_text(encoding="utf-8") for path in sorted(tmp_path.glob("*.yaml"))]
    texts = [*small * 4, *shipped]  # the large ones are parsed slowly
    file = tmp_path / "mutated.yaml"

    @hostile(12)
    def check(random: Random) -> None:
        put(random, file, lambda: text_of(random, texts))
        with own_errors():
            config, _ = load_with_places(file)
            drone = config.drone if hasattr(config, "drone") else config
            build_rig(drone.rig)

    check()
