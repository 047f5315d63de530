"""The simulator's control loop: a supervisor that knows of wind, and what each gate slowed its drone down for."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.safety import Action, Event, Gate, Objection, Permission, Request, Verdict
from flockd.review.metrics import min_distance
from flockd.sim.flock.control_loop import Commands, ControlLoop, SlowedTime
from flockd.sim.flock.exact_states import ExactFlock, step_times, vehicles_of
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import CameraFaultConfig, ScenarioConfig
from flockd.sim.vehicles.vehicles import Vehicles
from tests import make


class _Deaf(Vehicles):
    """Obeys no setpoint."""

    def step(
        self, setpoints: FloatArray, yaw_setpoints: FloatArray, interval_s: float, heights: FloatArray | None = None
    ) -> None:
        super().step(np.zeros_like(setpoints), yaw_setpoints, interval_s, heights)


def _flown(scenario: ScenarioConfig, vehicles: Vehicles) -> tuple[ControlLoop, FloatArray]:
    """The loop after the flight, and the places (S, N, 3) m at each step."""
    loop, flock, places = ControlLoop(scenario), ExactFlock(scenario), []
    for time_s in step_times(scenario):
        places.append(vehicles.position)
        commands = flock.step(float(time_s), vehicles.position, vehicles.velocity)
        loop.fly(float(time_s), vehicles, commands)
    return loop, np.array(places)


def test_steps_that_gates_would_not_bridge_are_refused_before_the_flight() -> None:
    """A gate sends nothing older than 1.5 s; 1.2 s and a latency of 0.25 s are less, 1.3 s and that are more."""
    flown, late = (make.scenario({"drone.step_s": step_s, "duration_s": 5.2}) for step_s in (1.2, 1.3))
    assert len(fly(flown, perception="truth").log.time_s) == 4
    with pytest.raises(UsageError, match=r"1\.55 s old, with drone\.step_s 1\.3 .*command_timeout_s 1\.5; write a"):
        fly(late, perception="truth")
    assert len(fly(late, perception="truth", gated=False).log.time_s) == 4


@pytest.mark.parametrize("edge", ["min_height_m", "max_height_m"])
def test_a_mission_may_fly_at_the_edge_of_the_heights(edge: str) -> None:
    """The autopilot's height errs by a tenth of a metre, for longer than `safety.outside_s`."""
    at_edge = {f"drone.safety.gate.{edge}": 5.0, "drone.mission.height_m": 5.0}
    scenario = make.scenario(at_edge | {"duration_s": 30.0})
    loop, places = _flown(scenario, vehicles_of(scenario))
    assert loop.handed_over == {}
    assert np.abs(places[-1, :, 2] + 5.0).max() < 1.0


def test_gusts_beyond_the_limit_end_in_hold_with_the_reason_and_nothing_touches() -> None:
    """0.5 m/s an axis, 0.7 m/s off; `safety.max_velocity_error_m_s` is 0.8. A held drone is kept where it is."""
    scenario = make.scenario({"duration_s": 60.0, "vehicle.gust_m_s": 0.8, "seed": 2})
    loop, places = _flown(scenario, Vehicles(scenario.vehicles, scenario.vehicle, seed=2))
    assert loop.handed_over.keys() == {0, 1, 2, 3, 4}
    for i, held in loop.handed_over.items():
        assert "differs from its setpoints" in held.reason
        after = places[int(held.time_s / 0.5) + 4 :, i, :2]
        assert np.linalg.norm(after - after.mean(axis=0), axis=1).max() < 3.0
    assert min(min_distance(step) for step in places) > 0.7
    assert loop.slowed.by_cause["wind"] > 0.1


def test_a_drone_whose_setpoints_have_no_effect_is_held_where_it_is_far_off() -> None:
    """Each drone stands. One is asked for 1 m/s, which is 0.8 m/s off after ten seconds; the others for less."""
    scenario = make.scenario({"duration_s": 20.0})
    still = [start.model_copy(update={"velocity_m_s": (0.0, 0.0)}) for start in scenario.vehicles]
    loop, places = _flown(scenario, _Deaf(still, scenario.vehicle))
    assert loop.handed_over
    assert max(held.time_s for held in loop.handed_over.values()) < 15.0
    np.testing.assert_allclose(places, np.broadcast_to(places[0], places.shape))


def test_gates_leave_a_flock_the_shape_that_the_law_gives_it() -> None:
    """A regular pentagon: in a flock that flies along, gaps close too. In calm air nobody is held or slowed by wind."""
    scenario = make.scenario({"duration_s": 62.0})
    loop, places = _flown(scenario, Vehicles(scenario.vehicles, scenario.vehicle))
    assert (loop.handed_over, "wind" in loop.slowed.by_cause) == ({}, False)
    plan = places[-1, :, :2]
    apart_m = np.sort(np.linalg.norm(plan[:, None] - plan[None], axis=2)[np.triu_indices(5, 1)])
    assert np.ptp(apart_m[:5]) < 0.015, "sides"
    assert np.ptp(apart_m[5:]) < 0.015, "diagonals"


def test_a_lost_camera_is_no_wind() -> None:
    """Drone 1, which wants 2 m/s, flies at the 1 m/s of a degraded one, until 2 s after its camera is back."""
    fault = CameraFaultConfig(drone=1, camera="left", begin_s=2.0, end_s=6.0)
    scenario = make.scenario({"duration_s": 10.0}, "encounter")
    far = scenario.vehicles[1].model_copy(update={"position_m": (30.0, 30.0, -5.0)})
    scenario = scenario.model_copy(update={"faults": (fault,), "vehicles": (scenario.vehicles[0], far)})
    loop, _ = _flown(scenario, Vehicles(scenario.vehicles, scenario.vehicle))
    assert "wind" not in loop.slowed.by_cause
    assert loop.slowed.by_cause["camera"] == pytest.approx(6.0 / 20.0, abs=0.02)


@pytest.mark.parametrize(
    ("action", "objections", "degraded_by", "causes"),
    [
        (Action.FLY, (Objection.SEPARATION, Objection.FENCE), (Event.CAMERA_LOST,), {"neighbour", "fence"}),
        (Action.FLY, (Objection.OBSTACLE,), (), {"obstacle"}),
        (Action.FLY, (Objection.COMMAND_TOO_LARGE,), (), {"other"}),
        (Action.FLY_DEGRADED, (), (Event.VELOCITY_OFF, Event.CAMERA_LOST), {"wind", "camera"}),
        (Action.FLY_DEGRADED, (Objection.SEPARATION,), (Event.HEIGHTS_LEFT,), {"neighbour", "other"}),
    ],
)
def test_what_a_gate_slowed_its_drone_down_for(
    action: Action, objections: tuple[Objection, ...], degraded_by: tuple[Event, ...], causes: set[str]
) -> None:
    """For a quarter of the time; in the rest it flew as it was asked to, but for 4 %."""
    wanted = Wanted(np.array([1.0, 0.0]), np.zeros(2), 0.0)
    request, slowed = Request(Permission(action, 0.0), wanted, 0.0, 5.0, make.around()), SlowedTime()
    assert (slowed.share, slowed.by_cause) == (None, {})
    for period_s, north_m_s in ((1.0, 0.5), (3.0, 0.96)):
        setpoint = Setpoint(0.0, np.array([north_m_s, 0.0]), 5.0, 0.0)
        slowed.add(period_s, request, Verdict(setpoint, objections), degraded_by)
    assert slowed.share == 0.25
    assert slowed.by_cause == dict.fromkeys(causes, 0.25)


def test_in_gusts_nothing_touches_among_trees() -> None:
    """0.3 m/s an axis among 100 trees a hectare."""
    of_gusts = {"vehicle.gust_m_s": 0.3, "vehicle.gust_length_m": 10.0, "world.obstacles.trees_per_hectare": 100.0}
    scenario = make.scenario(of_gusts | {"seed": 1, "duration_s": 20.0}, "forest")
    log = fly(scenario, perception="truth", pictured=False).log
    assert log.clearance is not None
    assert log.clearance.min() > scenario.vehicle.radius_m


def test_a_held_drone_takes_no_command_any_more() -> None:
    scenario = make.scenario({"duration_s": 30.0})
    loop, vehicles = ControlLoop(scenario), Vehicles(scenario.vehicles, scenario.vehicle)
    loop.hold(1, 0.0, vehicles)
    place = vehicles.position[1]
    asked = Commands.of(5)
    asked.velocity[:] = [1.0, 0.0]
    for step in range(20):
        loop.fly(0.5 * step, vehicles, asked)
    stop_m = 0.2 + 0.39 + 1.0 / (2 * 3.0)  # from 1 m/s, once it answers, at PX4's 3 m/s^2
    np.testing.assert_allclose(vehicles.position[1] - place, [stop_m, 0.0, 0.0], atol=0.02)
    assert vehicles.position[0, 0] - scenario.vehicles[0].position_m[0] == pytest.approx(10.0, abs=0.3)


def test_a_drone_that_is_taken_over_holds_or_lands_and_its_mates_keep_apart() -> None:
    takeovers = {"drone": 1, "time_s": 10.0, "to": "hold"}, {"drone": 4, "time_s": 12.0, "to": "land"}
    scenario = make.scenario({"duration_s": 25.0, "takeovers": takeovers})
    log = fly(scenario, perception="truth", pictured=False).log
    still = np.linalg.norm(log.velocity[-10:], axis=2).max(axis=0) < 0.4  # what the estimates wander by
    assert still.tolist() == [True, False, False, True, False]
    assert log.position[-1, 3, 2] > -0.1 > log.position[-1, 0, 2]
    held = log.metadata.handed_over[0]
    assert (held.time_s, "operator" in held.reason) == (10.0, True)
    assert log.metadata.slowed_share
    assert "neighbour" in log.metadata.slowed_by
    assert min(map(min_distance, log.position)) > 0.7


def test_gates_know_what_the_autopilots_estimate_and_not_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """But in an ideal world."""
    told: list[tuple[FloatArray, FloatArray]] = []
    step = Gate.step

    def noted(self: Gate, now_s: float, request: Request) -> Verdict:
        told.append((request.around.position, request.around.velocity))
        return step(self, now_s, request)

    monkeypatch.setattr(Gate, "step", noted)
    for ideal in (False, True):
        scenario = make.scenario({"ideal": ideal}, "encounter")
        loop, vehicles = ControlLoop(scenario), vehicles_of(scenario)
        loop.fly(0.0, vehicles, Commands.of(2))
        told.clear()
        before = vehicles.position.copy(), vehicles.velocity.copy()
        known = vehicles.known_position, vehicles.known_velocity
        loop.fly(0.5, vehicles, Commands.of(2))
        np.testing.assert_array_equal(told[0][0], known[0][0, :2])
        np.testing.assert_array_equal(told[0][1], known[1][0, :2])
        off = np.hypot(*(told[0][0] - before[0][0, :2])), np.hypot(*(told[0][1] - before[1][0, :2]))
        assert off == ((0.0, 0.0) if ideal else (pytest.approx(0.15, abs=0.149), pytest.approx(0.15, abs=0.149)))


def test_the_world_is_honest_unless_a_scenario_says_otherwise() -> None:
    honest, quick, ideal = (make.scenario(changes) for changes in ({}, {"drone.step_s": 0.1}, {"ideal": True}))
    assert (honest.step_latency_s, quick.step_latency_s, ideal.step_latency_s) == (0.25, 0.1, 0.0)
    assert honest.camera_faults is not None
    assert honest.camera_faults.timing.jitter_s > 0
    assert ideal.camera_faults is None
    ends = [{one.drone_of(i).mission.circle_until_s for i in range(5)} for one in (honest, ideal)]
    assert (len(ends[0]), ends[1]) == (5, {66.0})
    assert (honest.vehicle.dead_time_s, ideal.vehicle.dead_time_s) == (0.2, 0.0)
    assert make.scenario({"ideal": True, "vehicle.dead_time_s": 0.1}).vehicle.dead_time_s == 0.1
