"""A person writes a configuration, makes a slip, and is told where it is and how to mend it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from flockd.campaign.campaign_file import load_campaign
from flockd.core.config import DroneConfig, Overrides, load_drone
from flockd.core.config.document import core_scalar
from flockd.core.errors import ConfigError, ConfigProblem, ModelError
from flockd.flight.perception import load_networks
from flockd.sim.scenario import load_scenario, scenario_schema

CONFIG = Path(__file__).parents[3] / "config"

DRONE = """\
rig:
  cameras:
    - name: front
      size_px: [640, 480]
      intrinsics: {fx: 320, fy: 320.0, cx: 320, cy: 240}
"""
SCENARIO = """\
scenario: two
drone: drone.yaml
vehicles:
  - {position_m: [0, 0, -4]}
  - {position_m: [0, 5, -4]}
"""


REMEDY = r"\b(write|add|delete|put|did you mean|check|correct|close|save|flatten|give|move|name|copy|separate|keep)\b"
"""Every sentence says what to do."""


def _problems(path: Path) -> list[ConfigProblem]:
    """What is told of a file, each with its line, its key and what to do; files without their folder."""
    load = load_scenario if path.name == "scenario.yaml" else load_drone
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert len(str(caught.value).splitlines()) == min(len(caught.value.problems), 21), "one line a problem"
    for problem in caught.value.problems:
        assert re.search(REMEDY, problem.message), problem
    return [replace(problem, file=problem.file.replace(f"{path.parent}/", "")) for problem in caught.value.problems]


def _drone_problems(folder: Path, text: str) -> list[ConfigProblem]:
    path = folder / "drone.yaml"
    path.write_text(text, encoding="utf-8")
    return _problems(path)


def _places(problems: list[ConfigProblem]) -> list[str]:
    """Where they are, as in `drone.yaml:6: step_s`."""
    return [f"{problem.file}:{problem.line}: {problem.key}" for problem in problems]


def _with(line: str) -> str:
    return DRONE + line + "\n"


def test_the_papers_flight_is_table_1() -> None:
    scenario = load_scenario(CONFIG / "paper_flight.yaml")
    table_1 = [(-0.5, 0.9, -4.5), (0.5, -2.8, -4.0), (1.2, 4.5, -5.0), (3.9, 0.5, -3.5), (4.5, 1.4, -3.0)]
    assert [vehicle.position_m for vehicle in scenario.vehicles] == table_1
    assert {vehicle.velocity_m_s for vehicle in scenario.vehicles} == {(1.0, 0.0)}
    assert scenario.duration_s == 110.0
    assert scenario.drone.step_s == 0.5
    assert scenario.drone.flocking.desired_distance_m == 3.5


def test_whole_numbers_stand_for_floats_and_lists_for_tuples(tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    (tmp_path / "scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    scenario = load_scenario(tmp_path / "scenario.yaml")
    assert scenario.drone.rig.cameras[0].intrinsics.fx == 320.0
    assert isinstance(scenario.drone.rig.cameras[0].intrinsics.fx, float)
    assert scenario.vehicles[1].position_m == (0.0, 5.0, -4.0)


@pytest.mark.parametrize(
    ("text", "value"),
    [  # YAML 1.2.2, section 10.3.2 and its example 10.9, then what YAML 1.1 reads as something else
        ("null", None),
        ("~", None),
        ("", None),
        ("true", True),
        ("False", False),
        ("0", 0),
        ("0o7", 7),
        ("0x3A", 58),
        ("-19", -19),
        ("0.", 0.0),
        ("-0.0", 0.0),
        (".5", 0.5),
        ("+12e03", 12000.0),
        ("-2E+05", -200000.0),
        ("1e3", 1000.0),
        ("010", 10),
        ("-.INF", -math.inf),
        ("on", "on"),
        ("No", "No"),
        ("y", "y"),
        ("12:30", "12:30"),
        ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("2026-11-20", "2026-11-20"),
        ("=", "="),
    ],
)
def test_scalars_follow_the_core_schema(text: str, value: object) -> None:
    read = core_scalar(text)
    assert read == value
    assert type(read) is type(value)


def test_words_that_old_yaml_takes_for_truth_values_stay_words(tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text(DRONE.replace("name: front", "name: on"), encoding="utf-8")
    assert load_drone(path).rig.cameras[0].name == "on"


SLIPS = (
    ("step_s: -0.5", "step_s: -0.5 is not greater than 0; write a number of seconds above 0 and up to 60"),
    ("step_s: '0.5'", "step_s: '0.5' is not a number of seconds above 0 and up to 60; write 0.5"),
    ("stepp_s: 1", "stepp_s: is not a known key; did you mean `step_s`?"),
    ("yaw: 5", "yaw: 5 is not known; write `hold` or `course`"),
    ("name: my drone", "name: my drone is not a name; write my_drone"),
    ("step_s: .nan", "step_s: .nan is not finite"),
    ("step_s: 1e999", "step_s: 1e999 is not finite"),
    ("step_s: true", "step_s: true is not a number"),
    ("step_s: 1_000", "step_s: 1_000 is not a number of seconds above 0 and up to 60; write 1000"),
    ("step_s:", "step_s: has no value; write a number"),
    ("yaw: corse", "yaw: corse is not known; did you mean `course`?"),
    ("geometry: {refine: yes}", "geometry.refine: yes is not true or false; write true"),
    ("geometry: {hypotheses: 1e3}", "geometry.hypotheses: 1e3 is not a whole number from 1 to 100000; write 1000"),
    ("geometry: {min_inlier_ratio: 1}", "geometry.min_inlier_ratio: 1 is not less than 1"),
    ("perception: {flow: 5}", "perception.flow: 5 is not a text; put it in quotes"),
    ("perception: {threads: 99999999999999999999}", "perception.threads: 99999999999999999999 is too large"),
    ("flocking: {weight: [1]}", "flocking.weight: a list is not a section"),
    ("yaw: !!str hold", "yaw: the tag `tag:yaml.org,2002:str`"),
    ("yaw: &way hold", "yaw: the anchor `&way`"),
    ("yaw: *way", "yaw: the alias `*way`"),
    ("<<: {yaw: hold}", "<<: merge keys"),
    ("? [a]: 1", "a key must be a plain word"),
    ("---", "a second document begins here"),
    ("autopilot: {address: /dev/ttyAMA0}", "autopilot.address: /dev/ttyAMA0 is not an address; write an address, as"),
    ("telemetry: {listen: ['0.0.0.0:7447']}", "telemetry.listen[0]: '0.0.0.0:7447' is not a zenoh endpoint; write a"),
    ("autopilot: {obstacle_distance: true}", "autopilot.obstacle_distance: needs the map of obstacles"),
)


@pytest.mark.parametrize(("line", "told"), SLIPS, ids=[line for line, _ in SLIPS])
def test_a_slip_in_line_six_is_reported_with_what_to_do(tmp_path: Path, line: str, told: str) -> None:
    """What is cut off says in the same words what is wanted."""
    (problem,) = _drone_problems(tmp_path, _with(line))
    assert str(problem).startswith(f"drone.yaml:6: {told}")


def test_a_key_given_twice_is_refused(tmp_path: Path) -> None:
    (problem,) = _drone_problems(tmp_path, _with("step_s: 0.5\nyaw: hold\nstep_s: 0.1"))
    assert (problem.line, problem.key) == (8, "step_s")
    assert "first in line 6" in problem.message


@pytest.mark.parametrize(("escape", "shown"), [("\\0", "0x0000"), ("\\ud800", "0xd800")])
def test_a_text_that_no_program_takes_is_refused(escape: str, shown: str, tmp_path: Path) -> None:
    """In a pipeline it killed the camera's thread, after the check had passed it."""
    source = f"""\
source:
  kind: gstreamer
  cameras:
    - {{name: front, pipeline: "videotestsrc{escape} ! videoconvert"}}"""
    (problem,) = _drone_problems(tmp_path, _with(source))
    assert str(problem).startswith(f"drone.yaml:9: source.cameras[0].pipeline: holds the character {shown}, ")


def test_a_rig_without_cameras_is_refused(tmp_path: Path) -> None:
    assert _places(_drone_problems(tmp_path, "rig:\n  cameras: []\n")) == ["drone.yaml:2: rig.cameras"]
    assert _places(_drone_problems(tmp_path, "step_s: 1\n")) == ["drone.yaml:1: rig"]


def test_faults_inside_a_camera_name_the_camera(tmp_path: Path) -> None:
    text = DRONE.replace("[640, 480]", "[640]").replace("fx: 320,", "fx:320,").replace("cy: 240", "cy: 0")
    problems = _drone_problems(tmp_path, text)
    camera = "rig.cameras[0]"
    assert _places(problems) == [
        f"drone.yaml:4: {camera}.size_px",
        *(f"drone.yaml:5: {camera}.intrinsics.{key}" for key in ("cy", "fx", "fx:320")),
    ]
    assert problems[-1].message.endswith("put a space after the colon: `fx: 320`")


def test_two_cameras_of_one_name_are_refused(tmp_path: Path) -> None:
    twice = DRONE + DRONE.split("cameras:\n")[1]
    assert _places(_drone_problems(tmp_path, twice)) == ["drone.yaml:6: rig.cameras[1].name"]


@pytest.mark.fault("wrong-configuration")
def test_all_problems_of_both_files_come_at_once(tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(_with("stepp_s: 0.5\nyaw: corse"), encoding="utf-8")
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(SCENARIO.replace("[0, 5, -4]", "[0, 5]") + "duration_s: 0\n", encoding="utf-8")
    assert _places(_problems(scenario)) == [
        *("drone.yaml:6: stepp_s", "drone.yaml:7: yaw"),
        *("scenario.yaml:5: vehicles[1].position_m", "scenario.yaml:6: duration_s"),
    ]


def test_a_scenario_without_its_drones_file_has_one_fault_and_no_false_ones(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    for text in (SCENARIO, (CONFIG / "square.yaml").read_text(encoding="utf-8").replace("simulator.", "drone.")):
        scenario.write_text(text, encoding="utf-8")
        missing, named = _problems(scenario)
        assert (missing.file, missing.key) == ("drone.yaml", "")
        assert (named.file, named.key) == ("scenario.yaml", "drone")
    scenario.write_text(SCENARIO.replace("drone: drone.yaml\n", ""), encoding="utf-8")
    assert _places(_problems(scenario)) == ["scenario.yaml:1: drone"]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", ": is empty"),
        (b"# only a remark\n", ": is empty"),
        (b"---\n", ": is empty"),
        (b"- rig\n", ":1: is a list at its top level"),
        (b"rig\n", ":1: is a single value at its top level"),
        (b"step_s: 1\nrig: \xff\n", ":2: is not UTF-8 text"),
        (b"rig:\n\tcameras: []\n", ":2: a tab stands where YAML needs spaces"),
        (b"yaw: hold\nstep_s:1\nrig: {}\n", ":2: put a space after the `:`"),
        (b"a: 1\nrig: {b: 1\n", ":2: a bracket is opened here"),
        (b"yaw: 'hold\n\n", ":1: a quote is opened here"),
        (b"yaw: @hold\n", ":1: a value cannot begin with `@`"),
        (b"yaw: hold\nrig: \x01\n", ":2: holds the control character 0x01"),
        (b"a: " + b"[" * 100_000, ":1: is nested more than 32 levels deep"),
        (b"#" * (1 << 20) + b"\n", ": is larger than 1024 KiB"),
    ],
)
def test_a_file_that_cannot_be_read_gets_one_sentence(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "drone.yaml"
    path.write_bytes(content)
    (problem,) = _problems(path)
    assert str(problem).startswith(f"drone.yaml{told}")


def test_paths_that_are_no_files_get_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for path, told in (
        (tmp_path / "none.yaml", "does not exist"),
        (tmp_path / "folder", "is a folder"),
        (Path("/dev/zero"), "is not an ordinary file"),
    ):
        (problem,) = _problems(path)
        assert problem.message.startswith(told)


def test_of_very_many_problems_the_first_are_told_and_the_others_counted(tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text("rig:\n  cameras:\n" + "  - {lens: wide, colour: red}\n" * 300, encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        load_drone(path)
    *told, last = str(refused.value).splitlines()
    assert len(told) == 20
    assert all("is not a known key" in line or "is missing; add it" in line for line in told)
    assert told[0].startswith(f"{path}:3: rig.cameras[0]")
    found = len(refused.value.problems)
    assert found >= 300 * 4, "two unknown keys and two missing ones each"
    assert last == f"and {found - 20} more problems; correct these first"


def test_a_file_of_a_hundred_thousand_values_is_refused_before_it_is_read_through(tmp_path: Path) -> None:
    """The first of them are enough: the rest took 48 s to complain about."""
    path = tmp_path / "drone.yaml"
    path.write_text("rig:\n  cameras:\n" + "  - {a: 1, b: 2}\n" * 50_000, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"holds more than 30000 values, which no configuration does"):
        load_drone(path)


def test_a_windows_file_is_read_as_any_other(tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + DRONE.replace("\n", "\r\n").encode())
    assert load_drone(path).rig.cameras[0].size_px == (640, 480)


def test_overrides_win_over_both_files() -> None:
    overrides: Overrides = {"seed": 7, "drone.perception.flow": "dis", "drone.flocking.weight.kind": "nearest"}
    scenario = load_scenario(CONFIG / "paper_flight.yaml", overrides)
    assert scenario.seed == 7
    assert scenario.drone.perception.flow == "dis"
    assert scenario.drone.perception.depth == "neighbours_int8", "the rest of the section stays"
    assert scenario.drone.flocking.weight.kind == "nearest"


def test_a_relative_path_counts_from_the_folder_of_the_file_it_stands_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drones, elsewhere = tmp_path / "drones", tmp_path / "elsewhere"
    drones.mkdir()
    elsewhere.mkdir()
    folders = "models_dir: ../models, engines_dir: e"
    perception = f"perception: {{{folders}, flow: mine/flow.yaml, depth: /opt/depth.yaml, distance: none}}\n"
    (drones / "drone.yaml").write_text(f"{DRONE}{perception}telemetry: {{zenoh_config: tls.json5}}\n", encoding="utf-8")
    (tmp_path / "scenario.yaml").write_text(SCENARIO.replace("drone.yaml", "drones/drone.yaml"), encoding="utf-8")
    monkeypatch.chdir(elsewhere)
    alone, flown = load_drone("../drones/drone.yaml"), load_scenario("../scenario.yaml").drone
    for drone in (alone, flown):
        assert drone.perception.models_dir == str(tmp_path / "models")
        assert drone.perception.engines_dir == str(drones / "e")
        assert drone.perception.flow == str(drones / "mine" / "flow.yaml")
        assert drone.telemetry.zenoh_config == str(drones / "tls.json5")
        assert (drone.perception.depth, drone.perception.distance) == ("/opt/depth.yaml", "none")
        assert drone.perception.segmentation == "neighbours_int8", "a name is not a path"
    overridden = load_drone("../drones/drone.yaml", {"perception.models_dir": "here"})
    assert overridden.perception.models_dir == "here", "who overrides it stands elsewhere"


def test_models_that_are_not_there_are_reported_with_where_they_were_searched_for(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "drone.yaml").write_text(_with("perception: {models_dir: modles}"), encoding="utf-8")
    with pytest.raises(ModelError, match=rf"^perception\.models_dir: {tmp_path}/modles is no folder; name the one "):
        load_networks(load_drone(tmp_path / "drone.yaml").perception)
    (tmp_path / "drone.yaml").write_text(_with("perception: {models_dir: models}"), encoding="utf-8")
    with pytest.raises(
        ModelError, match=rf"^perception\.flow: there is no model 'flow_int8' \({tmp_path}/models/flow_int8\.yaml "
    ):
        load_networks(load_drone(tmp_path / "drone.yaml").perception)
    (tmp_path / "drone.yaml").write_text(_with("perception: {flow: my/flow.yaml}"), encoding="utf-8")
    with pytest.raises(ModelError, match=rf"\({tmp_path}/my/flow\.yaml is missing\)"):
        load_networks(load_drone(tmp_path / "drone.yaml").perception)


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
    ("", "faults: [{drone: 3, camera: front, kind: uniform}]", "2: faults[0].drone: is 3, but there are 2"),
    ("", "faults: [{drone: 1, camera: top, kind: uniform}]", "2: faults[0].camera: is not in the rig"),
    (
        *("", "faults: [{drone: 1, camera: front, kind: gaussian, begin_s: 5.0, end_s: 4.0}]"),
        "2: faults[0].end_s: is not after begin_s 5",
    ),
    (
        "",
        "world: {drone_family: 99}",
        "2: world.drone_family: 99 is not at most 13; write a whole number from 0 to 13 or",
    ),
    ("", "world:\n  obstacles:\n    kind: jungle", "4: world.obstacles.kind: jungle is not known; write `forest` or"),
    (
        *("", "world:\n  obstacles:\n    kind: forest\n    trees_per_hectare: 900"),
        "5: world.obstacles.trees_per_hectare: 900 is not at most 400",
    ),
    (
        *("", "world:\n  obstacles:\n    kind: village\n    trees_per_hectare: 100"),
        "5: world.obstacles.trees_per_hectare: has no meaning with kind `village`",
    ),
    ("", "duration_s: 0.1", "2: duration_s: 0.1 s is shorter than a step of 0.5 s"),
    ("", "duration_s: 1e6", "2: duration_s: 1e6 is not at most 86400"),
    (
        "  - {position_m: [0, 0, -4]}\n",
        "".join(f"  - {{position_m: [{north}, 0, -4]}}\n" for north in range(5000)),
        "3: vehicles: has 5001 entries",
    ),
)


@pytest.mark.parametrize(("old", "new", "told"), FLIGHTS, ids=[told for *_, told in FLIGHTS])
def test_a_flight_that_cannot_be_flown_is_refused_at_its_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    scenario = tmp_path / "scenario.yaml"
    text = SCENARIO.replace(old, new) if old else SCENARIO.replace("scenario: two", f"scenario: two\n{new}")
    scenario.write_text(text, encoding="utf-8")
    (problem,) = _problems(scenario)
    assert str(problem).startswith(f"scenario.yaml:{told}")


def test_a_principal_point_outside_the_image_is_refused_at_its_line(tmp_path: Path) -> None:
    outside = _drone_problems(tmp_path, DRONE.replace("cx: 320", "cx: 3200").replace("cy: 240", "cy: 480"))
    assert _places(outside) == [f"drone.yaml:5: rig.cameras[0].intrinsics.{key}" for key in ("cx", "cy")]


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
    (tmp_path / "scenario.yaml").write_text(
        SCENARIO.replace("drone: drone.yaml\n", inline.replace("cx: 320", "cx: -1")), encoding="utf-8"
    )
    assert _places(_problems(tmp_path / "scenario.yaml")) == ["scenario.yaml:7: drone.rig.cameras[0].intrinsics.cx"]


def test_the_configuration_knows_how_many_families_the_simulator_has() -> None:
    from flockd.sim.renderer.drone_models import FAMILIES
    from flockd.sim.scenario import DRONE_FAMILIES

    assert DRONE_FAMILIES == FAMILIES


def test_the_trim_that_an_error_recommends_is_taken_though_rounding_adds_up(tmp_path: Path) -> None:
    """0.2 + 0.1 is above 0.3 in binary."""
    limits = "flocking: {max_speed_m_s: 0.2}\nmission: {speed_m_s: 0.2}\n"
    limits += "safety: {gate: {max_speed_m_s: 0.3, degraded_speed_m_s: 0.3}}\n"
    (problem,) = _drone_problems(tmp_path, f"{DRONE}{limits}autopilot: {{max_velocity_trim_m_s: 0.2}}\n")
    assert problem.key == "autopilot.max_velocity_trim_m_s"
    path = tmp_path / "drone.yaml"
    path.write_text(f"{DRONE}{limits}autopilot: {{max_velocity_trim_m_s: 0.1}}\n", encoding="utf-8")
    assert load_drone(path).autopilot is not None


def test_what_is_wrong_with_a_camera_is_told_at_its_own_line(tmp_path: Path) -> None:
    quadrotor = (CONFIG / "quadrotor.yaml").read_text(encoding="utf-8")
    rig, source, rest = quadrotor.partition("\nsource:")
    line = 1 + (rig + source + rest[: rest.index("- name: back")]).count("\n")
    for text, told in (
        (rig + source + rest.replace("- name: back", "- name: bak", 1), f"{line}: source.cameras[2].name"),
        (rig + source + rest.replace("- name: back", "- name: left", 1), "source.cameras[3].name"),
        (rig.replace("- name: right", "- name: front") + source + rest, "rig.cameras[1].name"),
        (quadrotor.replace("usb-0:2:1.0", "usb-0:1:1.0"), "source.cameras[1].device"),
    ):
        assert any(told in place for place in _places(_drone_problems(tmp_path, text)))
