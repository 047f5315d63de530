"""A real drone flies no faster than was shown to be safe, and slowly and in a layer of its own at first."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config import DroneConfig, load_drone, load_real_drone
from flockd.core.config.real_drone import PROVEN_M_S
from flockd.core.errors import ConfigError
from flockd.ground.doctor.setup_checks import check_limits
from flockd.sim.sitl.processes import free_port
from tests.core.config.test_loader import CONFIG
from tests.core.config.test_loader import DRONE as RIG

AUTOPILOT = f"autopilot: {{address: udpin://127.0.0.1:{free_port()}, max_velocity_trim_m_s: 0.5}}\n"
FLOCK = range(1, 6)
SEPARATION_M = 3.0
"""Nearer above or below than this counts as at one height: the lower is in the other's downwash."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "drone.yaml"


def _write(file: Path, law: float = 2.0, gate: float = 4.0, more: str = AUTOPILOT) -> str:
    file.write_text(
        f"{RIG}flocking:\n  max_speed_m_s: {law}\nsafety:\n  gate:\n    max_speed_m_s: {gate}\n{more}", encoding="utf-8"
    )
    return str(file)


def _flown(file: Path, layer: int, mission: str, law: float = 3.0) -> DroneConfig:
    text = f"safety: {{first_flight_layer: {layer}}}\nflocking: {{max_speed_m_s: {law}}}\nmission: {mission}\n"
    file.write_text(RIG + AUTOPILOT + text, encoding="utf-8")
    return load_real_drone(file)[0]


@pytest.mark.parametrize("command", [["config", "check"], ["doctor", "--config"], ["run", "--config"]], ids=" ".join)
def test_a_speed_outside_the_envelope_is_refused_with_its_line(
    command: list[str], file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, _write(file, law=5.0, gate=6.0)]) == 78
    law, gate = capsys.readouterr().err.splitlines()
    assert law.startswith(f"{file}:7: flocking.max_speed_m_s: 5 m/s is above the 2 m/s ")
    assert gate.startswith(f"{file}:10: safety.gate.max_speed_m_s: 6 m/s is above the 4 m/s ")
    assert "--force" in law


@pytest.mark.parametrize(
    ("command", "then"),
    [
        (["config", "check"], (0, "")),
        (["doctor", "--only", "memory", "--config"], (0, "")),
        (["run", "--config"], (78, "{file}: source: is missing")),
    ],
    ids=["config check", "doctor", "run"],
)
def test_force_goes_beyond_it_with_a_warning(
    command: list[str], then: tuple[int, str], file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, _write(file, law=2.1), "--force"]) == then[0]
    warning, _, rest = capsys.readouterr().err.partition("\n")
    assert warning.startswith(f"warning: {file}:7: flocking.max_speed_m_s: 2.1 m/s is above the 2 m/s ")
    assert then[1].format(file=file) in rest


@pytest.mark.parametrize(
    ("law", "gate", "refused"),
    [(2.0, 4.0, 0), (2.001, 4.0, 1), (2.0, 4.001, 1), (1.0, 9.0, 1), (2.5, 4.5, 2)],
)
def test_the_envelope_ends_where_the_encounters_did(law: float, gate: float, refused: int, file: Path) -> None:
    _write(file, law, gate)
    assert len(load_real_drone(file)[1]) == refused


def test_shipped_drones_are_inside_the_laws_default_is_not_and_studies_may_go_beyond(file: Path) -> None:
    for inside in (CONFIG / "quadrotor.yaml", CONFIG / "px4_sitl.yaml", CONFIG / "simulator.yaml"):
        assert load_real_drone(inside)[1] == []
    file.write_text(RIG + AUTOPILOT, encoding="utf-8")
    (problem,) = load_real_drone(file)[1]
    assert str(problem).startswith(f"{file}: flocking.max_speed_m_s: is not given, and its default of 3 m/s is above ")
    assert main(["config", "check", _write(file, law=9.0, gate=9.0, more="")]) == 0, "it has no autopilot to fly"


@pytest.mark.parametrize(
    "mission",
    [
        "{kind: hover, height_m: 20.0}",
        "{kind: velocity, velocity_m_s: [2.0, -1.5], height_offset_m: 2.0}",
        "{speed_m_s: 3.0}",
        "{kind: waypoints, speed_m_s: 2.0, waypoints: [{north_m: 9, east_m: 0, height_m: 5, speed_m_s: 3},"
        " {north_m: 0, east_m: 0, speed_m_s: 0.5}]}",
    ],
    ids=["hover", "velocity", "circle", "waypoints"],
)
def test_first_flights_are_slow_and_in_layers_whatever_the_mission(mission: str, file: Path) -> None:
    flock = [_flown(file, layer, mission) for layer in FLOCK]
    heights = [(drone.mission.height_m or math.nan) + drone.mission.height_offset_m for drone in flock]
    assert heights[0] == 3.0
    for one, other in itertools.combinations(heights, 2):
        assert abs(one - other) > SEPARATION_M + 0.5
    for drone in flock:
        assert [place.height_m for place in drone.mission.waypoints] == [None] * len(drone.mission.waypoints)
        assert drone.flocking.max_speed_m_s == 1.0
        speeds = [drone.mission.speed_m_s, *(place.speed_m_s or 0.0 for place in drone.mission.waypoints)]
        assert max(*speeds, math.hypot(*(drone.mission.velocity_m_s or (0.0, 0.0)))) <= 1.0
        assert DroneConfig.model_validate(drone.model_dump()) == drone, "recordings hold what was flown"


def test_first_flights_change_the_drones_flight_alone(file: Path) -> None:
    flown = _flown(file, 2, "{kind: velocity, speed_m_s: 0.8, velocity_m_s: [0.6, 0.5]}", law=0.8)
    assert flown.mission.velocity_m_s == (0.6, 0.5), "slow already"
    assert flown.flocking.max_speed_m_s == 0.8
    as_written = load_drone(file)
    assert as_written.mission.height_m is None, "for a simulation"
    assert flown.safety == as_written.safety


@pytest.mark.parametrize(
    ("safety", "told"),
    [
        ("{first_flight_layer: 8}", "leads to a height of 31 m, and safety.gate allows 1 to 30 m"),
        ("{first_flight_layer: 1, gate: {min_height_m: 3.5}}", "leads to a height of 3 m, and safety.gate allows 3.5"),
        ("{first_flight_layer: 1, gate: {vertical_separation_m: 4.0}}", "puts drones 4 m above each other"),
        ("{first_flight_layer: 0}", "0 is not at least 1"),
    ],
)
def test_a_layer_that_cannot_be_flown_is_refused(safety: str, told: str, file: Path) -> None:
    file.write_text(f"{RIG}safety: {safety}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_real_drone(file)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (6, "safety.first_flight_layer")
    assert told in problem.message


@pytest.mark.parametrize(
    ("text", "about", "level"),
    [
        ("safety: {first_flight_layer: 3}\n", "on: layer 3, 11 m above the ground at home, 1 m/s", "PASS"),
        ("flocking: {max_speed_m_s: 2.0}\n", "off: 2 m/s at most", "PASS"),
        ("flocking: {max_speed_m_s: 3.5}\n", "3.5 m/s is above the 2 m/s", "WARNING"),
    ],
)
def test_doctor_says_whether_it_is_a_first_flight(text: str, about: str, level: str, file: Path) -> None:
    file.write_text(RIG + AUTOPILOT + text, encoding="utf-8")
    found = [finding for finding in check_limits(load_real_drone(file)[0]) if about in finding.measured]
    assert [finding.level.value for finding in found] == [level]


@pytest.mark.parametrize("name", ["quadrotor.yaml", "templates/drone.yaml"])
def test_the_files_name_the_speed_that_was_proven(name: str) -> None:
    """Where they say how far the speed may be raised."""
    said = re.findall(r"([0-9.]+) is (?:.*)the most that was proven", (CONFIG / name).read_text(encoding="utf-8"))
    assert [float(speed) for speed in said] == [PROVEN_M_S["flocking", "max_speed_m_s"]]
