"""Mistakes in a configuration are told with file, line, key and remedy."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.config.document import core_scalar
from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig, RigConfig, field_of_view_deg
from flockd.core.errors import ConfigError, ConfigProblem, ModelError
from flockd.flight.perception import load_networks

CONFIG = Path(__file__).parents[3] / "config"

DRONE = """\
rig:
  cameras:
    - name: front
      size_px: [640, 480]
      intrinsics: {fx: 320, fy: 320.0, cx: 320, cy: 240}
"""
REMEDY = r"\b(write|add|delete|put|did you mean|check|correct|close|save|flatten|give|move|name|copy|separate|keep)\b"
"""Every sentence says what to do."""


def problems_in(path: Path, load: Callable[[Path], object] = load_drone) -> list[ConfigProblem]:
    """What is told of a file, each with its line, its key and what to do; files without their folder."""
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert len(str(caught.value).splitlines()) == min(len(caught.value.problems), 21), "one line a problem"
    for problem in caught.value.problems:
        assert re.search(REMEDY, problem.message), problem
    return [replace(problem, file=problem.file.replace(f"{path.parent}/", "")) for problem in caught.value.problems]


def _drone_problems(folder: Path, text: str) -> list[ConfigProblem]:
    path = folder / "drone.yaml"
    path.write_text(text, encoding="utf-8")
    return problems_in(path)


def places_of(problems: list[ConfigProblem]) -> list[str]:
    """Where they are, as in `drone.yaml:6: step_s`."""
    return [f"{problem.file}:{problem.line}: {problem.key}" for problem in problems]


def with_line(line: str) -> str:
    return DRONE + line + "\n"


def test_a_file_is_read_as_a_person_means_it(tmp_path: Path) -> None:
    """Whole numbers stand for floats and lists for tuples, old truth values are words, and it may be a Windows file."""
    path = tmp_path / "drone.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + DRONE.replace("name: front", "name: on").replace("\n", "\r\n").encode())
    (camera,) = load_drone(path).rig.cameras
    assert (camera.intrinsics.fx, type(camera.intrinsics.fx), camera.size_px) == (320.0, float, (640, 480))
    assert camera.name == "on"


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


CAMERA, SLOW = "{name: front, device: /dev/video0}", "shared_memory: {speed_factor: 0.5}"
CABLE = "autopilot: {address: 'serial:///dev/ttyS1:921600'}"
LANDS = "kind: waypoints, at_end: land, waypoints: [{north_m: 30, east_m: 0}]"
SLIPS = (
    ("step_s: -0.5", "step_s: -0.5 is not greater than 0; write a number of seconds above 0 and up to 60"),
    ("step_s: '0.5'", "step_s: '0.5' is not a number of seconds above 0 and up to 60; write 0.5"),
    ("stepp_s: 1", "stepp_s: is not a known key; did you mean `step_s`?"),
    ("yaw: 5", "yaw: 5 is not known; write `hold` or `course`"),
    ("name: my drone", "name: my drone is not a name; write my_drone"),
    ("step_s: .nan", "step_s: .nan is not finite"),
    ("step_s: 1e999", "step_s: 1e999 is not finite"),
    ("step_s: true", "step_s: true is not a number"),
    ("step_s: 1_0", "step_s: 1_0 is not a number of seconds above 0 and up to 60; write 10"),
    ("step_s:", "step_s: has no value; write a number"),
    ("yaw: corse", "yaw: corse is not known; did you mean `course`?"),
    ("geometry: {refine: yes}", "geometry.refine: yes is not true or false; write true"),
    ("geometry: {hypotheses: 1e3}", "geometry.hypotheses: 1e3 is not a whole number from 1 to 100000; write 1000"),
    ("geometry: {hypotheses: 1e9}", "geometry.hypotheses: 1e9 is not a whole number from 1 to 100000; write a whole"),
    ("safety: {alone_s: '1e5'}", "safety.alone_s: '1e5' is not a number of seconds above 0 and up to 3600 or nothing"),
    (
        "safety: {gate: {fence_corners_m: [[-5, -5], [10, 5], [10, -10], [-5, 10]]}}",
        "safety.gate: fence_corners_m is an outline that crosses itself; write the corners in order",
    ),
    (
        "safety: {gate: {fence_corners_m: [[5, -5], [5, 5], [15, 0]]}}",
        "safety.gate: fence_corners_m leaves home outside, from which they count; write corners around 0, 0",
    ),
    (
        "mission: {radius_m: 101, circle_until_s: 999}",
        "mission.radius_m: leads 202 m away on the circle, and the fence is 200 m across",
    ),
    (
        "mission: {radius_m: 1e3, circle_until_s: 500}",
        "mission.radius_m: leads 495 m away on the circle, and the fence",
    ),
    (f"mission: {{{LANDS}, height_offset_m: -4}}", "mission.at_end: `land` leads down onto drones of other layers"),
    (f"mission: {{{LANDS}}}\nsafety: {{first_flight_layer: 1}}", "mission.at_end: `land` leads down onto drones of"),
    ("flocking: {desired_distance_m: 20}", "flocking.desired_distance_m: 20 is not below observation_distance_m 20"),
    ("telemetry: {listen: ['tcp/[::1]:1'], connect: ['tcp/[::1]:1']}", "telemetry: tcp/[::1]:1 is named twice in"),
    ("name: ..", "name: .. is not a name; write"),
    (f"name: {'n' * 65}", "name: nnnnnnnnnn"),
    ("yaw:\u00a0hold", "another space than the keyboard's stands here, as web pages have it; write a plain one"),
    (  # half-way, at 27.9 degrees, a degree of latitude is 110.84 km and one of longitude 98.46
        "mission: {kind: waypoints, waypoints: [{latitude_deg: 47.3, longitude_deg: 8.5}, "
        "{latitude_deg: 8.5, longitude_deg: 47.3}]}",
        "mission.waypoints[1]: is 5752 km (are latitude and longitude swapped, or a sign?) from the first",
    ),
    (
        "mission: {kind: waypoints, waypoints: [{north_m: 1, east_m: 1}, {latitude_deg: 47.3, longitude_deg: 8.5}, "
        "{latitude_deg: 47.303, longitude_deg: 8.5}]}",
        "mission.waypoints[2]: is 333.5 m from the first of those in degrees, and the fence is 200 m across",
    ),
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
    ("autopilot: {address: 'serial:///dev/ttyAMA0'}", "autopilot.address: serial:///dev/ttyAMA0 has no baud rate; "),
    ("autopilot: {system_id: 255}", "autopilot.system_id: 255 is not at most 250"),  # PX4's largest MAV_SYS_ID
    ("autopilot: {low_battery_share: 1}", "autopilot.low_battery_share: 1 is not less than 1"),
    (
        f"source: {{kind: v4l2, cameras: [{CAMERA[:-1]}, controls: [{{name: a, value: 1}}, {{name: a, value: 2}}]}}]}}",
        "source.cameras[0].controls[1].name: a is set twice; delete one",
    ),
    ("autopilot: {address: /dev/ttyAMA0}", "autopilot.address: /dev/ttyAMA0 is not an address; write an address, as"),
    ("telemetry: {listen: ['0.0.0.0:7447']}", "telemetry.listen[0]: '0.0.0.0:7447' is not a zenoh endpoint; write a"),
    (f"source: {{kind: v4l2, cameras: [{CAMERA}], {SLOW}}}", "source: real cameras need real time; delete"),
    (f"source: {{kind: shared_memory, {SLOW.replace('0.5', '0.01')}}}", "source.shared_memory.speed_factor: 0.01 is"),
    (f"source: {{kind: shared_memory, {SLOW}}}\n{CABLE}", "source.shared_memory.speed_factor: is for simulations, and"),
)


@pytest.mark.parametrize(("line", "told"), SLIPS, ids=[line for line, _ in SLIPS])
def test_a_slip_in_line_six_is_reported_with_what_to_do(tmp_path: Path, line: str, told: str) -> None:
    """What is cut off says in the same words what is wanted."""
    (problem,) = _drone_problems(tmp_path, with_line(line))
    assert str(problem).startswith(f"drone.yaml:6: {told}")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("flocking: {max_speed_m_s: 0.5}", "1: mission.speed_m_s: is not given, and by default 1 m/s is above what"),
        ("flocking: {max_speed_m_s: 0.5}\nmission: {}", "7: mission.speed_m_s: is not given, and by default 1 m/s is"),
        (
            f"safety: {{gate: {{command_fresh_s: 0.3}}}}\n{CABLE}",
            "1: step_s: is not given, and by default 0.5 s is above safety.gate.command_fresh_s 0.3",
        ),
        (
            "source: {kind: shared_memory, shared_memory: {rate_hz: 1}}",
            "1: step_s: is not given, and by default 0.5 s is below the 1.000 s between two images of the fastest",
        ),
        ("safety: {gate: {max_height_m: 0.5}}\nmission: {height_m: 5}", "6: safety.gate: min_height_m 1 is not below"),
        # Of drones that are 3 m wide the tips meet where the middles are 3 m apart.
        (
            "perception: {drone_size_m: 3.0}",
            "1: safety.gate.min_separation_m: is not given, and by default 1 m is not above perception.drone_size_m 3",
        ),
        (
            "safety: {degraded_temperature_c: 70.0, max_temperature_c: 185.0}",
            "6: safety.max_temperature_c: 185.0 is not at most 125; ",
        ),
    ],
)
def test_a_default_that_does_not_fit_what_is_given_is_told_with_its_key(tmp_path: Path, line: str, told: str) -> None:
    (problem,) = _drone_problems(tmp_path, with_line(line))
    assert str(problem).startswith(f"drone.yaml:{told}")


GSTREAMER = 'source:\n  kind: gstreamer\n  cameras:\n    - {name: front, pipeline: "videotestsrc%s ! x"}'
PIPELINE = "source.cameras[0].pipeline"


@pytest.mark.parametrize(
    ("text", "places", "told"),
    [
        (with_line("step_s: 0.5\nyaw: hold\nstep_s: 0.1"), ["8: step_s"], "first in line 6"),
        # In a pipeline these killed the camera's thread, after the check had passed them.
        (with_line(GSTREAMER % "\\0"), [f"9: {PIPELINE}"], "holds the character 0x0000"),
        (with_line(GSTREAMER % "\\ud800"), [f"9: {PIPELINE}"], "holds the character 0xd800"),
        ("rig:\n  cameras: []\n", ["2: rig.cameras"], "at least 1"),
        ("step_s: 1\n", ["1: rig"], "is missing"),
        (DRONE + DRONE.split("cameras:\n")[1], ["6: rig.cameras[1].name"], "share the name"),
        (
            DRONE.replace("cx: 320", "cx: 3200").replace("cy: 240", "cy: 480"),
            [f"5: rig.cameras[0].intrinsics.{key}" for key in ("cx", "cy")],
            "of the image off the middle of 640 x 480 images",
        ),
    ],
    ids=["twice", "zero", "surrogate", "no cameras", "no rig", "one name", "principal point"],
)
def test_a_slip_is_told_at_its_line(text: str, places: list[str], told: str, tmp_path: Path) -> None:
    problems = _drone_problems(tmp_path, text)
    assert places_of(problems) == [f"drone.yaml:{place}" for place in places]
    assert told in problems[0].message


def test_faults_inside_a_camera_name_the_camera(tmp_path: Path) -> None:
    text = DRONE.replace("[640, 480]", "[640]").replace("fx: 320,", "fx:320,").replace("cy: 240", "cy: 0")
    problems = _drone_problems(tmp_path, text)
    camera = "rig.cameras[0]"
    assert places_of(problems) == [
        f"drone.yaml:4: {camera}.size_px",
        *(f"drone.yaml:5: {camera}.intrinsics.{key}" for key in ("cy", "fx", "fx:320")),
    ]
    assert problems[-1].message.endswith("put a space after the colon: `fx: 320`")


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
    (problem,) = problems_in(path)
    assert str(problem).startswith(f"drone.yaml{told}")


def test_what_is_no_file_or_has_more_values_than_any_gets_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before it is read through: the rest took 48 s to complain about."""
    monkeypatch.setattr("flockd.core.config.document.MAX_VALUES", 300)
    many = tmp_path / "many.yaml"
    many.write_text("rig:\n  cameras:\n" + "  - {a: 1, b: 2}\n" * 500, encoding="utf-8")
    for path, told in (
        (tmp_path / "none.yaml", "does not exist"),
        (tmp_path, "is a folder"),
        (Path("/dev/zero"), "is not an ordinary file"),
        (many, "holds more than 300 values"),
    ):
        (problem,) = problems_in(path)
        assert problem.message.startswith(told)


def test_of_very_many_problems_the_first_are_told_and_the_others_counted(tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text("rig:\n  cameras:\n" + "  - {lens: wide, colour: red}\n" * 30, encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        load_drone(path)
    *told, last = str(refused.value).splitlines()
    assert len(told) == 20
    assert told[0].startswith(f"{path}:3: rig.cameras[0]")
    found = len(refused.value.problems)
    assert found >= 30 * 4, "two unknown keys and two missing ones each"
    assert last.startswith(f"and {found - 20} more problems")


def test_models_that_are_not_there_are_reported_with_where_they_were_searched_for(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    for keys, told in (
        ("models_dir: modles", rf"^perception\.models_dir: {tmp_path}/modles is no folder"),
        ("models_dir: models", rf"^perception\.flow: there is no model 'flow_int8' \({tmp_path}/models/flow_int8"),
        ("flow: my/flow.yaml", rf"\({tmp_path}/my/flow\.yaml is missing\)"),
    ):
        (tmp_path / "drone.yaml").write_text(with_line(f"perception: {{{keys}}}"), encoding="utf-8")
        with pytest.raises(ModelError, match=told):
            load_networks(load_drone(tmp_path / "drone.yaml").perception)


def test_a_relative_path_counts_from_the_folder_of_the_file_it_stands_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drones, elsewhere = tmp_path / "drones", tmp_path / "elsewhere"
    drones.mkdir()
    elsewhere.mkdir()
    folders = "models_dir: ../models, engines_dir: e"
    perception = f"perception: {{{folders}, flow: mine/flow.yaml, depth: /opt/depth.yaml, detector: none}}\n"
    (drones / "drone.yaml").write_text(f"{DRONE}{perception}telemetry: {{zenoh_config: tls.json5}}\n", encoding="utf-8")
    monkeypatch.chdir(elsewhere)
    drone = load_drone("../drones/drone.yaml")
    assert drone.perception.models_dir == str(tmp_path / "models")
    assert drone.perception.engines_dir == str(drones / "e")
    assert drone.perception.flow == str(drones / "mine" / "flow.yaml")
    assert drone.telemetry.zenoh_config == str(drones / "tls.json5")
    assert (drone.perception.depth, drone.perception.detector) == ("/opt/depth.yaml", "none")
    assert drone.perception.segmentation == "neighbours_int8", "a name is not a path"
    overridden = load_drone("../drones/drone.yaml", {"perception.models_dir": "here"})
    assert overridden.perception.models_dir == "here", "who overrides it stands elsewhere"


def test_the_trim_that_an_error_recommends_is_taken_though_rounding_adds_up(tmp_path: Path) -> None:
    """0.2 + 0.1 is above 0.3 in binary."""
    limits = "flocking: {max_speed_m_s: 0.2}\nmission: {speed_m_s: 0.2}\n"
    limits += "safety: {gate: {max_speed_m_s: 0.3, degraded_speed_m_s: 0.3}}\n"
    (problem,) = _drone_problems(tmp_path, f"{DRONE}{limits}autopilot: {{max_velocity_trim_m_s: 0.2}}\n")
    assert problem.key == "autopilot.max_velocity_trim_m_s"
    path = tmp_path / "drone.yaml"
    path.write_text(f"{DRONE}{limits}autopilot: {{max_velocity_trim_m_s: 0.1}}\n", encoding="utf-8")
    assert load_drone(path).autopilot is not None


@pytest.mark.parametrize(
    ("step_s", "limits", "named"),
    [
        (0.9, "estimate_timeout_s: 1.8, gate: {command_timeout_s: 1.8}", None),
        (0.91, "estimate_timeout_s: 1.9, gate: {command_timeout_s: 1.9}", "safety.gate.command_fresh_s 0.9"),
        (0.75, "", None),
        (0.76, "", "half of safety.estimate_timeout_s 1.5"),
    ],
)
def test_steps_that_a_flight_would_wait_for_are_refused(
    tmp_path: Path, step_s: float, limits: str, named: str | None
) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text(f"{DRONE}step_s: {step_s}\nsafety: {{{limits}}}\n", encoding="utf-8")
    load_drone(path)  # a simulated drone's steps wait for nothing
    if named is None:
        load_drone(path, {"autopilot": {}})
    else:
        with pytest.raises(ConfigError, match=f"step_s: {step_s:g} s is above {named}"):
            load_drone(path, {"autopilot": {}})


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("autopilot.address", "udpin://0.0.0.0:99999", "has the port 99999; write one from 1 to 65535"),
        ("autopilot.address", "serial:///dev/ttyAMA0:12345", "has the baud rate 12345, which no port has; write"),
        ("autopilot.address", "serial:///dev/ttyAMA0:9600", "has the baud rate 9600, too slow for what the autopilot"),
        ("autopilot.address", "serial:///dev/ttyAMA0:38400", "too slow for what the autopilot has to send; write"),
        ("autopilot.address", "serial:///dev/serial/by-path/usb-0:1:1", "has the baud rate 1, which no port has"),
        ("autopilot.address", "udpout://0.0.0.0:14540", "names no computer to send to; write the autopilot's address"),
        (
            "mission",
            {"kind": "operator", "speed_m_s": 0},
            "0 m/s leads nowhere with kind `operator`; write more, or kind",
        ),
        (
            "mission",
            {"kind": "waypoints", "waypoints": ({"north_m": 9, "east_m": 0},), "reached_m": 100},
            "100 m is not below half of the 200 m across the fence: waypoints count as reached from home; write a",
        ),
        ("telemetry.listen", ("tcp/127.0.0.1:7447", "tls/0.0.0.0:70000?x=1"), "has the port 70000"),
        ("telemetry.connect", ("udp/10.0.0.1:65536",), "has the port 65536"),
        ("telemetry.listen", ("tcp/0.0.0.0:0",), "has the port 0; write one from 1 to 65535"),
        ("autopilot.address", "udpin://192.168.1.300:14540", "has the host 192.168.1.300; write an IP address or a"),
        ("autopilot.address", "udpin://[::]:14540", "has the host [::]; write an IP address or a computer's name"),
        ("telemetry.listen", ("tcp/drone 1:7447",), "has the host drone 1; write an IP address or a computer's name"),
        ("telemetry.connect", ("tcp/[1:2:7447",), "has the host [1:2; write an IP address or a computer's name"),
    ],
)
def test_an_address_that_nothing_can_open_and_a_mission_that_leads_nowhere_are_refused(
    key: str, value: Any, told: str, tmp_path: Path
) -> None:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_drone(tmp_path / "drone.yaml", {key: value})
    assert told in str(caught.value)


def test_an_address_may_have_colons_in_its_path_and_every_port(tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    by_path = "serial:///dev/serial/by-path/platform-xhci-hcd.1-usb-0:1:1.0-port0:57600"
    listen = ("tcp/0.0.0.0:65535", "tcp/[fe80::1%eth0]:1", "udp/pi-4_b.local:2", "tls/relay.example.org:3#iface=wlan0")
    overrides: dict[str, Any] = {"autopilot.address": by_path, "telemetry.listen": listen}
    config = load_drone(tmp_path / "drone.yaml", overrides)
    assert config.autopilot is not None
    assert config.autopilot.address == by_path


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
        assert any(told in place for place in places_of(_drone_problems(tmp_path, text)))


def _camera(size: tuple[int, int], **lens: object) -> CameraConfig:
    values = {"fx": 320.0, "fy": 320.0, "cx": size[0] / 2, "cy": size[1] / 2, **lens}
    return CameraConfig(name="front", size_px=size, intrinsics=IntrinsicsConfig.model_validate(values))


@pytest.mark.parametrize("turns", [("1.5708", "3.1416", "4.7124"), ("1.57", "3.14", "-1.57")])
def test_mountings_in_radians_are_refused_and_those_of_a_calibration_are_not(
    turns: tuple[str, ...], tmp_path: Path
) -> None:
    text = (CONFIG / "quadrotor.yaml").read_text(encoding="utf-8")
    degrees = ("yaw_deg: 90.0", "yaw_deg: 180.0", "yaw_deg: 270.0")
    for right, wrong in zip(degrees, turns, strict=True):
        text = text.replace(right, f"yaw_deg: {wrong}")
    problems = _drone_problems(tmp_path, text)
    assert [problem.key for problem in problems] == [f"rig.cameras[{n}].extrinsics.yaw_deg" for n in (1, 2, 3)]
    assert problems[0].message == f"{float(turns[0]):g} is in radians, as all the others are; write degrees"
    (tmp_path / "drone.yaml").write_text(text.replace(f"yaw_deg: {turns[1]}", "yaw_deg: 179.3"), encoding="utf-8")
    load_drone(tmp_path / "drone.yaml")
    near = {f"front{n}": ExtrinsicsConfig(yaw_deg=0.004 - 0.005 * n) for n in (0, 1)}
    RigConfig(
        cameras=tuple(
            _camera((640, 480)).model_copy(update={"name": name, "extrinsics": one}) for name, one in near.items()
        )
    )


def test_how_wide_a_camera_sees() -> None:
    pinhole, fisheye = (_camera((640, 480), model=model).intrinsics for model in ("pinhole", "wide_angle"))
    assert field_of_view_deg(pinhole, (640, 480)) == pytest.approx(90.0, abs=0.01)  # 2 atan(320 / 320)
    assert field_of_view_deg(fisheye, (480, 640)) == pytest.approx(math.degrees(2.0), abs=0.01)  # 640 / 320 rad
    # k1 = 0.1: 0.9161 (1 + 0.1 * 0.9161^2) = 0.9930
    bent = _camera((640, 480), fx=320 / 0.9930, fy=320 / 0.9930, distortion=(0.1, 0.0, 0.0, 0.0)).intrinsics
    assert field_of_view_deg(bent, (640, 480)) == pytest.approx(2 * math.degrees(math.atan(0.9161)), abs=0.01)


@pytest.mark.parametrize(
    ("size", "lens", "key", "told"),
    [
        (
            (640, 480),
            {"distortion": (0.1,) * 8},
            "distortion",
            "has 8 coefficients; pinhole takes none, or k1",
        ),
        ((640, 480), {"model": "wide_angle", "distortion": (0.1,) * 5}, "distortion", "has 5 coefficients"),
        ((640, 480), {"fx": 1.019, "fy": 1.0, "cx": 320.0}, "fx", "shows no direction at the border of 640 x 480"),
        ((640, 480), {"fx": 130.0, "fy": 130.0}, "fx", "gives 136 degrees of 640 x 480 images, and between 5 and 130"),
        ((640, 480), {"fx": 9000.0, "fy": 9000.0}, "fx", "gives 4 degrees"),
        ((640, 480), {"fx": 240.0}, "fy", "320 and fx 240 differ by more than 15%"),
        # Calibrated at twice and half the size, and for an image that stands upright.
        ((640, 480), {"cx": 639.0}, "cx", "639 is 50% of the image off the middle"),
        ((640, 480), {"cx": 160.0}, "cx", "160 is 25% of the image off the middle"),
        ((480, 640), {"cx": 320.0}, "cx", "320 is 17% of the image off the middle"),
        # Turns back at r = 0.82 of the focal length (1 - 3 * 0.5 r^2 = 0), where it images 0.54; the border is at 1.
        ((640, 480), {"distortion": (-0.5, 0.0, 0.0, 0.0)}, "fx", "shows no direction at the border"),
        # The border is at r (1 + 5 r^2) = 1: r = 0.4725..
        ((640, 480), {"distortion": (5.0, 0.0, 0.0, 0.0)}, "distortion", "to 212% of their distance from the middle"),
        ((640, 480), {"distortion": (5.0, 5.0, 5.0, 5.0, 5.0)}, "distortion", "of their distance from the middle, and"),
        ((640, 480), {"distortion": (0.0, 0.0, 0.04, 0.0)}, "distortion", "by p1 and p2 by 12% of their distance"),
        (
            (640, 480),
            {"model": "wide_angle", "distortion": (5.0, 0.0, 0.0, 0.0)},
            "distortion",
            "to 212% of their distance from the middle, and real lenses to 60% to 150%, up to the border of 640 x 480",
        ),
    ],
)
def test_a_calibration_that_cannot_be_true_is_refused(
    size: tuple[int, int], lens: dict[str, object], key: str, told: str
) -> None:
    with pytest.raises(ValidationError) as caught:
        _camera(size, **lens)
    (error,) = caught.value.errors()
    assert (error["loc"], told in error["msg"]) == (("intrinsics", key), True)


def test_keys_without_an_effect_are_told_by_config_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drone.yaml"
    idle = "recording: {jpeg_quality: 50}\nperception: {drone_size_sigma_m: 0.1}\n"
    path.write_text(DRONE + idle, encoding="utf-8")
    assert main(["config", "check", str(path)]) == 0
    told = capsys.readouterr().err
    assert ": recording.jpeg_quality: has no effect, as recording.images is png; delete it, or change that\n" in told
    assert ": perception.drone_size_sigma_m: has no effect, as there is no drone_size_m; " in told
    path.write_text(DRONE + idle.replace("{", "{images: jpeg, ", 1).replace("{dr", "{drone_size_m: 0.4, dr"), "utf-8")
    assert main(["config", "check", str(path)]) == 0
    assert "has no effect" not in capsys.readouterr().err


def test_a_view_that_no_network_was_trained_on_is_told_by_config_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text(DRONE.replace("{fx: 320, fy: 320.0,", "{model: wide_angle, fx: 203.7, fy: 203.7,"))
    assert main(["config", "check", str(path)]) == 0
    assert f"warning: {path}: camera front: " in (told := capsys.readouterr().err)
    assert "more than 63 degrees right, left, above or below of the axis, where no network was trained" in told
