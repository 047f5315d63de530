"""A real drone flies no faster than it can stop in time, and slowly and in a layer of its own at first."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config import DroneConfig, load_drone, load_real_drone
from flockd.core.config.real_drone import safe_speeds
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


def _write(file: Path, law: float, more: str = AUTOPILOT, gate: float = 4.0) -> str:
    safety = f"safety: {{gate: {{max_speed_m_s: {gate}}}}}\nmission: {{speed_m_s: 0.1}}\n"
    file.write_text(f"{RIG}{safety}flocking:\n  max_speed_m_s: {law}\n{more}", encoding="utf-8")
    return str(file)


def _flown(file: Path, layer: int, mission: str, law: float = 3.0) -> DroneConfig:
    text = f"safety: {{first_flight_layer: {layer}}}\nflocking: {{max_speed_m_s: {law}}}\nmission: {mission}\n"
    file.write_text(RIG + AUTOPILOT + text, encoding="utf-8")
    return load_real_drone(file)[0]


def _nearer_m(speed_m_s: float, own_m_s2: float, other_m_s2: float, late_s: float, meets: bool) -> float:
    """How much nearer a drone comes that brakes `late_s` after another does; both do so late where they meet."""
    time_s = np.arange(0.0, 20.0, 1e-3)
    own_m_s = np.maximum(speed_m_s - own_m_s2 * np.maximum(time_s - late_s, 0.0), 0.0)
    other_m_s = np.maximum(speed_m_s - other_m_s2 * np.maximum(time_s - late_s * meets, 0.0), 0.0)
    return float(1e-3 * (own_m_s + (other_m_s if meets else -other_m_s)).sum())


@pytest.mark.parametrize(
    ("values", "late_s", "room_m"),
    [
        # a step and one as long, and 0.5 s; 3.5 m and 7 m that are 9 % less, and 1 m that is kept
        ({}, 1.5, (2.185, 5.37)),
        ({"step_s": 0.1, "safety.degraded_load": 0.5}, 0.65, (2.185, 5.37)),
        ({"flocking.desired_distance_m": 8.0, "safety.gate.braking_m_s2": 3.0}, 1.5, (6.28, 5.37)),
        ({"safety.gate.reaction_s": 0.3, "safety.gate.min_separation_m": 1.5}, 1.3, (1.685, 4.87)),
        ({"safety.gate.max_acceleration_m_s2": 1.0}, 1.5, (2.185, 5.37)),  # a mate brakes no less than the drone
        ({"flocking.desired_distance_m": 1.0}, 1.5, (0.0, 5.37)),
    ],
)
def test_it_keeps_the_distance_up_to_the_speed_and_not_above_it(
    values: dict[str, float], late_s: float, room_m: tuple[float, float], file: Path
) -> None:
    _write(file, law=1.0)
    config = load_drone(file, values)
    own_m_s2, mates_m_s2 = config.safety.gate.braking_m_s2, config.safety.gate.max_acceleration_m_s2
    behind_m_s, meeting_m_s = safe_speeds(config)
    behind_m = _nearer_m(behind_m_s, own_m_s2, max(own_m_s2, mates_m_s2), late_s, False)
    assert (behind_m, _nearer_m(meeting_m_s, own_m_s2, own_m_s2, late_s, True)) == pytest.approx(room_m, abs=0.01)


@pytest.mark.parametrize("command", [["config", "check"], ["doctor", "--config"], ["run", "--config"]], ids=" ".join)
def test_a_speed_outside_the_envelope_is_refused_with_its_line(
    command: list[str], file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, _write(file, law=2.0, gate=4.5)]) == 78
    gate, law = capsys.readouterr().err.splitlines()
    assert gate.startswith(f"{file}:6: safety.gate.max_speed_m_s: 4.5 m/s is above the 4 m/s ")
    assert law.startswith(f"{file}:9: flocking.max_speed_m_s: 2 m/s is above the 1.22 m/s from which the drone stops ")
    more = "write 1.22 or less, or a larger flocking.desired_distance_m or a smaller step_s, or take it with --force"
    assert law.endswith(f" in time before a mate that stops; {more}")


@pytest.mark.parametrize(
    ("command", "then"),
    [
        (["config", "check"], (0, "")),
        (["doctor", "--only", "memory", "--config"], (0, "")),
        (["run", "--config"], (78, "{file}: source: is missing")),
    ],
)
def test_force_goes_beyond_it_with_a_warning(
    command: list[str], then: tuple[int, str], file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, _write(file, law=1.23), "--force"]) == then[0]
    warning, _, rest = capsys.readouterr().err.partition("\n")
    assert warning.startswith(f"warning: {file}:9: flocking.max_speed_m_s: 1.23 m/s is above the 1.22 m/s ")
    assert then[1].format(file=file) in rest


@pytest.mark.parametrize(
    ("law", "apart_m", "stops_for"),
    [(1.22, 3.5, None), (1.23, 3.5, "a mate that stops"), (1.36, 8.0, None), (1.38, 8.0, "one that comes as fast")],
)
def test_what_is_written_is_what_may_be_flown(law: float, apart_m: float, stops_for: str | None, file: Path) -> None:
    _write(file, law, more=f"  desired_distance_m: {apart_m}\n{AUTOPILOT}")
    told = "".join(problem.message for problem in load_real_drone(file)[1])
    assert told == "" if stops_for is None else f"in time before {stops_for};" in told


def test_where_no_speed_is_low_enough_none_is_advised(file: Path) -> None:
    _write(file, law=0.1, more=f"  desired_distance_m: 1.0\n{AUTOPILOT}")
    (problem,) = load_real_drone(file)[1]
    assert problem.message.endswith(
        "; write a larger flocking.desired_distance_m or a smaller step_s, or take it with --force"
    )


def test_shipped_drones_are_inside_the_laws_default_is_not_and_studies_may_go_beyond(file: Path) -> None:
    for inside in (CONFIG / "quadrotor.yaml", CONFIG / "px4_sitl.yaml", CONFIG / "simulator.yaml"):
        assert load_real_drone(inside)[1] == []
    file.write_text(RIG + AUTOPILOT, encoding="utf-8")
    (problem,) = load_real_drone(file)[1]
    assert str(problem).startswith(f"{file}: flocking.max_speed_m_s: is not given, and its default of 3 m/s is above ")
    assert main(["config", "check", _write(file, law=3.0, more="")]) == 0, "it has no autopilot to fly"


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
        ("flocking: {max_speed_m_s: 1.2}\n", "off: 1.2 m/s at most", "PASS"),
        ("flocking: {max_speed_m_s: 3.5}\n", "3.5 m/s is above the 1.22 m/s", "WARNING"),
    ],
)
def test_doctor_says_whether_it_is_a_first_flight(text: str, about: str, level: str, file: Path) -> None:
    file.write_text(RIG + AUTOPILOT + text, encoding="utf-8")
    found = [finding for finding in check_limits(load_real_drone(file)[0]) if about in finding.measured]
    assert [finding.level.value for finding in found] == [level]


def test_the_page_has_the_speeds_of_the_formula(file: Path) -> None:
    rows = re.findall(
        r"^\| ([0-9.]+) s \|(.*)\|$", (CONFIG.parent / "docs/envelope.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    _write(file, law=1.0)
    for step_s, cells in rows:
        *behind, meeting = [float(cell.split()[0]) for cell in cells.split("|")]
        for spacing_m, told_m_s in zip((2.5, 3.5, 5.0, 7.0), behind, strict=True):
            values = {"step_s": float(step_s), "flocking.desired_distance_m": spacing_m}
            assert (told_m_s, meeting) == pytest.approx(safe_speeds(load_drone(file, values)), abs=0.01)
    assert len(rows) == 3
