"""Missions flown by a point that goes as they want, and by flocks on exact states."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.mission import MissionParameters, fault_of_place
from flockd.core.config.safety import GateParameters
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray, MissionOrder, Setpoint
from flockd.flight.geometry import euler_from_rotation
from flockd.flight.mission import Moment, Navigator, order_fault
from flockd.flight.mission.guidance import Guidance
from flockd.flight.mission.navigator import MAX_TURN_RAD_S, Lookout
from flockd.flight.safety import Gate, outside_fence
from flockd.onboard.telemetry.order_messages import parse_order
from flockd.sim.autopilot.fake_vehicle import Demand, Flown
from flockd.sim.flock.exact_states import fly_exact_states
from flockd.sim.scenario import load_scenario
from tests.core.config.test_loader import CONFIG, DRONE
from tests.flight.geometry.synthetic_world import four_camera_rig
from tests.make import around, changed, request, vehicle
from tests.sim.scenario.test_scenario_file import SCENARIO

GATE = GateParameters()
ORIGIN = np.zeros(2)


def mission(**keys: object) -> MissionParameters:
    return MissionParameters.model_validate(keys)


def to(*places: tuple[float, float], **keys: object) -> MissionParameters:
    waypoints = tuple({"north_m": north, "east_m": east} for north, east in places)
    return mission(kind="waypoints", waypoints=waypoints, **keys)


class Point:
    """A drone that flies just as its mission wants, alone, a step every half second."""

    def __init__(self, parameters: MissionParameters, gate: GateParameters = GATE) -> None:
        self.navigator = Navigator(parameters, gate)
        self.position: FloatArray = ORIGIN
        self.time_s = 0.0

    def step(self, order: MissionOrder | None = None) -> Guidance:
        guidance = self.navigator.step(Moment(self.time_s, self.position, order=order))
        self.position = self.position + 0.5 * guidance.velocity
        self.time_s += 0.5
        return guidance

    def fly(self, seconds: float) -> Guidance:
        return [self.step() for _ in range(round(2 * seconds))][-1]


def test_waypoints_are_flown_to_in_order_at_their_speed_and_the_last_is_held() -> None:
    point = Point(to((10.0, 0.0), (10.0, 5.0), speed_m_s=2.0))
    first = point.step()
    np.testing.assert_allclose(first.velocity, [2.0, 0.0])
    assert (first.course_rad, first.sentence, first.arrived) == (0.0, "10 m to waypoint 1 of 2", False)
    point.fly(4.0)
    np.testing.assert_allclose(point.position, [9.0, 0.0])  # as near as reached_m
    second = point.step()
    assert second.goal is not None
    np.testing.assert_allclose(second.goal, [10.0, 5.0])
    np.testing.assert_allclose(second.velocity, np.array([1.0, 5.0]) * (2.0 / math.sqrt(26.0)))
    last = point.fly(20.0)
    assert (last.arrived, last.takeover, last.sentence) == (True, None, "at waypoint 2 of 2")
    np.testing.assert_allclose(point.position, [10.0, 5.0], atol=0.01)
    point.position = np.array([10.0, 8.0])  # blown away
    np.testing.assert_allclose(point.step().velocity, [0.0, -1.5])  # 3 m in SLOW_DOWN_S


def test_a_flock_whose_drones_see_different_middles_does_not_stop_between_two_waypoints() -> None:
    """Two drones pull a flock, each where it wants; one misses neighbours and sees the middle 1.6 m east of it."""
    route = to((20.0, 0.0), (20.0, 20.0), (0.0, 20.0))
    drones = [(Navigator(route, GATE), np.zeros(2)), (Navigator(route, GATE), np.array([0.0, 1.6]))]
    middle, nearest_m = ORIGIN, {(20.0, 0.0): math.inf, (20.0, 20.0): math.inf, (0.0, 20.0): math.inf}
    for step in range(200):
        wanted = [drone.step(Moment(0.5 * step, middle, off)) for drone, off in drones]
        middle = middle + 0.5 * np.mean([guidance.velocity for guidance in wanted], axis=0)
        nearest_m = {goal: min(best, math.dist(goal, middle)) for goal, best in nearest_m.items()}
    assert all(guidance.arrived for guidance in wanted)
    assert max(nearest_m.values()) < 2.0


@pytest.mark.parametrize("stops_at_m", [0.0, 10.0])
def test_a_drone_that_has_not_come_near_has_not_been_there(stops_at_m: float) -> None:
    """It waits on the ground, 4 m from its first waypoint, or is held 10 m before it, and knows where it is to go."""
    begins_m = 4.0 if stops_at_m == 0.0 else 30.0
    point = Point(to((begins_m, 0.0), (40.0, 40.0)))
    for _ in range(240):
        guidance = point.step()
        point.position = np.minimum(point.position, [stops_at_m if stops_at_m == 0.0 else begins_m - stops_at_m, 0.0])
    assert guidance.sentence.endswith("to waypoint 1 of 2")


@pytest.mark.parametrize("end", ["land", "return"])
def test_at_its_end_a_mission_has_the_autopilot_take_over(end: str) -> None:
    point = Point(to((2.0, 0.0), at_end=end))
    assert point.step().takeover is None
    last = point.fly(10.0)
    assert last.takeover == end
    np.testing.assert_allclose(last.velocity, ORIGIN)


def test_degrees_are_metres_from_home() -> None:
    # On the WGS 84 ellipsoid at 47.4 degrees north: 111 170 m and 75 450 m a degree (NIMA TR8350.2's formulas).
    place = {"latitude_deg": 47.4 + 10 / 111_170, "longitude_deg": 8.5 - 20 / 75_450}
    navigator = Navigator(mission(kind="waypoints", waypoints=(place,)), GATE)
    blind = navigator.step(Moment(0.0, ORIGIN))
    assert "home" in blind.sentence
    np.testing.assert_allclose(blind.velocity, ORIGIN)
    goal = navigator.step(Moment(0.5, ORIGIN, home_deg=np.array([47.4, 8.5]))).goal
    assert goal is not None
    np.testing.assert_allclose(goal, [10.0, -20.0], atol=0.05)
    far = Navigator(mission(kind="waypoints", waypoints=(place,)), GATE)
    outside = far.step(Moment(0.0, ORIGIN, home_deg=np.array([47.5, 8.5])))
    assert "fence" in outside.sentence
    np.testing.assert_allclose(outside.velocity, ORIGIN)


def test_an_operators_velocity_and_goal_hold_for_two_seconds() -> None:
    point = Point(mission(kind="operator"))
    assert "hovers" in point.step().sentence
    for order in (MissionOrder(velocity=np.array([0.5, 0.0])), MissionOrder(place=np.array([40.0, 0.0]))):
        speeds = [math.hypot(*point.step(order).velocity), *(math.hypot(*point.step().velocity) for _ in range(5))]
        assert [speed > 0 for speed in speeds] == [True, True, True, True, False, False]


def test_a_goal_takes_the_place_of_any_other_mission_for_good() -> None:
    point = Point(mission(speed_m_s=1.5))
    circling = point.navigator.status(point.step())
    assert (circling.kind, circling.sentence, circling.goal) == ("circle_then_tangent", "on the circle", None)
    np.testing.assert_allclose(circling.desired, [1.5, 0.0])
    point.step(MissionOrder(velocity=np.array([0.0, 0.5])))
    point.fly(4.0)
    ordered = point.step(MissionOrder(place=np.array([0.0, 20.0]), height_m=7.0, speed_m_s=0.5))
    assert ordered.height_m == 7.0
    assert math.hypot(*ordered.velocity) == pytest.approx(0.5)
    status = point.navigator.status(point.fly(60.0))
    assert (status.kind, status.arrived) == ("waypoints", True)
    np.testing.assert_allclose(point.position, [0.0, 20.0], atol=1.0)


PLACE, VELOCITY = MissionOrder(place=np.array([40.0, 0.0])), MissionOrder(velocity=np.array([0.5, 0.0]))


@pytest.mark.parametrize("kind", ["circle_then_tangent", "operator"])
@pytest.mark.parametrize("first", [PLACE, VELOCITY], ids=["goal", "velocity"])
@pytest.mark.parametrize("second", [PLACE, VELOCITY], ids=["then goal", "then velocity"])
def test_an_order_without_a_height_keeps_the_last_one_ordered(
    kind: str, first: MissionOrder, second: MissionOrder
) -> None:
    """And so it does when the order has lapsed; the drone's offset counts once."""
    point = Point(mission(kind=kind, height_m=4.0, height_offset_m=1.0))
    assert point.step().height_m == 5.0
    assert point.step(replace(first, height_m=8.0)).height_m == 9.0
    assert point.step(second).height_m == 9.0
    assert {point.step().height_m for _ in range(10)} == {9.0}


@pytest.fixture
def config(tmp_path: Path) -> DroneConfig:
    (tmp_path / "drone.yaml").write_text(DRONE, encoding="utf-8")
    return load_drone(tmp_path / "drone.yaml")


@pytest.mark.parametrize(
    ("message", "command", "refusal"),
    [
        ({"north_m": 90.0, "east_m": 0.0}, "goto", None),
        ({"north_m": 90.0, "east_m": 80.0}, "goto", "120.4 m from home, outside the fence of 100 m"),
        ({"latitude_deg": 48.0, "longitude_deg": 8.0}, "goto", "home in degrees"),
        ({"north_m": 9.0, "east_m": 0.0, "height_m": 31.0}, "goto", "31 m"),
        ({"north_m": 9.0, "east_m": 0.0, "speed_m_s": 3.5}, "goto", "3.5 m/s"),
        ({"velocity_ne": [3.0, 0.0]}, "velocity", None),
        ({"velocity_ne": [3.0, 2.0]}, "velocity", "3.60555 m/s"),
    ],
)
def test_an_order_that_cannot_be_flown_is_refused_with_the_reason(
    config: DroneConfig, message: dict[str, object], command: str, refusal: str | None
) -> None:
    order = parse_order(command, message)
    fault = order_fault(config, order, vehicle())
    assert fault is None if refusal is None else fault is not None and refusal in fault
    assert order_fault(config, order, None) is not None


def test_in_first_flights_no_order_takes_a_drone_out_of_its_layer(config: DroneConfig) -> None:
    order = MissionOrder(place=np.array([9.0, 0.0]), height_m=7.0)
    assert order_fault(config, order, vehicle()) is None
    first = changed(config, safety__first_flight_layer=1)
    assert "layer" in str(order_fault(first, order, vehicle()))
    assert order_fault(first, replace(order, height_m=None), vehicle()) is None


def test_a_velocity_that_leads_out_of_the_fence_is_refused_and_one_back_is_not(config: DroneConfig) -> None:
    edge = vehicle(position=[98.0, 0.0])
    outward, inward = (MissionOrder(velocity=np.array([speed, 0.0])) for speed in (1.5, -1.5))
    assert "101.0 m" in str(order_fault(config, outward, edge))
    assert order_fault(config, inward, edge) is None
    assert order_fault(config, inward, vehicle(position=[130.0, 0.0])) is None


@pytest.mark.parametrize(
    ("written", "told"),
    [
        ("{kind: spiral}", "mission.kind: "),
        ("{kind: hover, radius_m: 5.0}", "mission.radius_m: "),
        ("{kind: waypoints}", "mission.kind: .*`waypoints`"),
        ("{kind: velocity}", "mission.kind: .*`velocity_m_s`"),
        ("{kind: velocity, velocity_m_s: [3, 3]}", "mission.velocity_m_s: 4.24264 m/s"),
        ("{speed_m_s: 4.5}", "mission.speed_m_s: 4.5 m/s"),
        ("{kind: hover, height_m: 40}", "mission.height_m: .* 40 m"),
        ("{kind: waypoints, waypoints: [{north_m: 1, east_m: 2}, {north_m: 90, east_m: 50}]}",
         r"mission.waypoints\[1\]: .*103.0 m"),
        ("{kind: waypoints, waypoints: [{north_m: 1}]}", r"mission.waypoints\[0\].*`east_m`"),
    ],
)  # fmt: skip
def test_a_bad_mission_is_refused_with_line_and_key(tmp_path: Path, written: str, told: str) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text(f"{DRONE}mission: {written}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=f"drone.yaml:6: {told}") as caught:
        load_drone(path)
    assert len(str(caught.value).splitlines()) == 1


def test_in_a_scenario_the_mission_is_of_all_and_one_drone_may_have_its_own(tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(f"{DRONE}mission: {{kind: hover}}\n", encoding="utf-8")
    path = tmp_path / "scenario.yaml"
    own = "  - {position_m: [5, 0, -4], mission: {kind: velocity, velocity_m_s: [1, 0]}}\n"
    path.write_text(f"{SCENARIO}{own}mission: {{kind: follow, pull: 2.0}}\n", encoding="utf-8")
    scenario = load_scenario(path, {"drone.mission.pull": 3.0})
    assert [scenario.drone_of(i).mission.kind for i in range(3)] == ["follow", "follow", "velocity"]
    assert scenario.drone.mission.pull == 3.0
    path.write_text(f"{SCENARIO}{own.replace('[1, 0]', '[9, 0]')}mission: {{kind: fly}}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"scenario.yaml:7: drone.mission.kind|scenario.yaml:7: mission.kind"):
        load_scenario(path)
    path.write_text(f"{SCENARIO}{own.replace('[1, 0]', '[9, 0]')}", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"scenario.yaml:6: vehicles\[2\].mission.velocity_m_s: 9 m/s"):
        load_scenario(path)


def test_the_configuration_and_the_gate_agree_on_what_is_outside() -> None:
    corners = ((-8.0, -10.0), (-8.0, 10.0), (10.0, 10.0), (10.0, 2.0), (2.0, 2.0), (2.0, -10.0))
    gate = GateParameters(fence_radius_m=12.0, fence_corners_m=corners)
    rng = np.random.default_rng(0)
    places = rng.uniform(-14.0, 14.0, (500, 2))
    verdicts = [(fault_of_place(gate, *place.tolist()) is not None, outside_fence(gate, place)) for place in places]
    assert all(one == other for one, other in verdicts)
    assert 0 < sum(one for one, _ in verdicts) < 500


def test_one_of_five_knows_the_goal_and_all_arrive_within_ten_metres() -> None:
    _, position, _ = fly_exact_states(load_scenario(CONFIG / "one_knows.yaml", {"duration_s": 45.0}))
    plan = position[-1, :, :2]
    assert np.linalg.norm(plan[:, None] - plan, axis=-1).max() < 10.0
    assert np.linalg.norm(plan - [25.0, 10.0], axis=1).max() < 10.0


def test_those_who_see_a_drone_that_is_flown_by_hand_go_with_it() -> None:
    scenario = load_scenario(CONFIG / "led_by_hand.yaml", {"duration_s": 65.0})
    _, position, velocity = fly_exact_states(scenario)
    assert np.linalg.norm(position[-1, :, :2] - [20.0, 10.0], axis=1).max() < 10.0
    # A person's drone goes as the person wants, wherever the others are: 0.5 m/s straight to the north at first.
    np.testing.assert_allclose(velocity[20, 0], [0.5, 0.0, 0.0], atol=0.01)


def test_a_mission_changes_the_height_and_lands_at_its_end() -> None:
    flight = load_scenario(CONFIG / "led_by_hand.yaml", {"duration_s": 30.0})
    waypoints = ({"north_m": 6.0, "east_m": 0.0, "height_m": 6.0},)
    lands = mission(kind="waypoints", at_end="land", waypoints=waypoints)
    alone = changed(flight, vehicles=(changed(flight.vehicles[0], mission=lands, by_hand=False),))
    heights = -fly_exact_states(alone)[1][:, 0, 2]
    assert heights.max() == pytest.approx(6.0, abs=0.15)
    assert heights[-1] == pytest.approx(0.0, abs=0.01)


# Laps: mission, gate and vehicle in closed loop, turning to one side all the time.


def test_four_squares_are_flown_without_standing_and_with_the_heading_along() -> None:
    """To the left, of 12 m at 1.5 m/s; the gate is stepped each 0.1 s, the mission each 0.5 s."""
    corners = [(12.0, 0.0), (12.0, -12.0), (0.0, -12.0), (0.0, 0.0)] * 4
    navigator, gate = Navigator(to(*corners, speed_m_s=1.5, reached_m=1.0), GATE), Gate(GATE)
    fly = Flown(np.array([0.0, 0.0, -5.0]))
    state = fly(Demand(np.zeros(2), -5.0, 0.0), 0.0)
    setpoints: list[Setpoint] = []
    turned_rad, yaw_rad = 0.0, 0.0
    for tick in range(3000):
        now_s = 0.1 * tick
        if tick % 5 == 0:
            guidance, wanted_s = navigator.step(Moment(now_s, state.position[:2])), now_s
            if guidance.arrived:
                break
        near = around(state.position[:2], state.velocity[:2], yaw_rad=yaw_rad)
        asked = request(now_s, guidance.velocity, surroundings=near, yaw_rad=guidance.course_rad, wanted_s=wanted_s)
        verdict = gate.step(now_s, asked)
        assert verdict.objections == ()
        assert verdict.setpoint is not None
        setpoints.append(verdict.setpoint)
        state = fly(Demand(verdict.setpoint.velocity, -5.0, verdict.setpoint.yaw_rad), 0.1)
        before_rad, yaw_rad = yaw_rad, euler_from_rotation(state.R_ned_body)[2]
        turned_rad += math.remainder(yaw_rad - before_rad, math.tau)
    assert guidance.sentence == "at waypoint 16 of 16"
    assert turned_rad == pytest.approx(-4 * math.tau, abs=2.0), "as often as it went around"
    speeds = np.hypot(*np.array([setpoint.velocity for setpoint in setpoints[10:-40]]).T)
    assert speeds.min() > 0.75, "it never stands"
    headings = [setpoint.yaw_rad for setpoint in setpoints]
    assert all(-math.pi < heading <= math.pi for heading in headings)
    jumps = [abs(math.remainder(after - before, math.tau)) for before, after in pairwise(headings)]
    assert max(jumps) <= 0.2 * 0.5 + 1e-9  # turns no faster than 0.2 rad/s, a step of 0.5 s at once


@pytest.mark.parametrize(
    ("cameras", "ahead_deg", "turned_deg"),
    [
        ({"front"}, 0.0, 60.0),  # 15 degrees beyond where the right camera's image begins, or the left one's
        ({"back"}, 0.0, 0.0),
        ({"right"}, 80.0, 50.0),  # a heading that is held, of a drone that flies sideways
        ({"front", "right", "left"}, 0.0, 150.0),
        ({"front", "right", "back", "left"}, 0.0, 0.0),
    ],
)
def test_the_heading_turns_until_a_camera_looks_where_the_drone_wants_to_fly(
    cameras: set[str], ahead_deg: float, turned_deg: float
) -> None:
    """It heads 20 degrees east of north, and is slow in no direction."""
    lookout, gone, heading_rad = Lookout(four_camera_rig()), frozenset(cameras), math.radians(20.0)
    course_rad = heading_rad + math.radians(ahead_deg)
    way = np.array([math.cos(course_rad), math.sin(course_rad)])
    before = [lookout.heading(0.5 * step, heading_rad, way, frozenset()) for step in range(3)]
    turned = [lookout.heading(1.5 + 0.5 * step, heading_rad, way, gone) for step in range(40)]
    assert before == [heading_rad] * 3
    turned = [rad - heading_rad for rad in turned]
    assert max(abs(b - a) for a, b in pairwise([0.0, *turned])) <= 0.5 * MAX_TURN_RAD_S + 1e-12
    assert math.degrees(abs(turned[-1])) == pytest.approx(turned_deg)
    assert lookout.heading(60.0, heading_rad, 0.1 * way, frozenset()) == pytest.approx(heading_rad + turned[-1])
    assert lookout.heading(90.0, heading_rad, way, frozenset()) == heading_rad, "they are back"


def test_a_camera_that_misses_a_frame_hardly_turns_the_heading() -> None:
    lookout, north = Lookout(four_camera_rig()), np.array([1.0, 0.0])
    gone = [frozenset({"front"} if step == 4 else ()) for step in range(8)]
    turned = [lookout.heading(0.5 * step, 0.0, north, cameras) for step, cameras in enumerate(gone)]
    assert [round(abs(math.degrees(rad))) for rad in turned] == [0, 0, 0, 0, 6, 0, 0, 0]
