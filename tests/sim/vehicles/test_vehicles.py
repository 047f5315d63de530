"""Simulated vehicles against the analytic first-order lag, plain mechanics and scipy's rotations; the truth flight."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flockd.core.config.flocking import FlockingParameters
from flockd.flight.geometry import rotation_from_euler
from flockd.review.metrics import min_distance, obj2, pair_distances
from flockd.sim.flock.exact_states import fly_exact_states
from flockd.sim.scenario import SensorConfig, StartConfig, VehicleConfig
from flockd.sim.vehicles.vehicles import SimulatedAutopilot, Vehicles, attitude
from tests import make

Array = NDArray[np.float64]
START = StartConfig(position_m=(1.0, 2.0, -4.0))
NO_YAW = np.zeros(1)

AT_ONCE = VehicleConfig(dead_time_s=0.0, velocity_time_constant_s=0.25, max_acceleration_m_s2=4.0, max_jerk_m_s3=1e9)


def _yaw_pitch_roll_deg(R_ned_body: Array) -> Array:
    return np.asarray(Rotation.from_matrix(R_ned_body).as_euler("ZYX", degrees=True))


def test_velocity_responds_to_a_setpoint_as_a_first_order_lag() -> None:
    tau = AT_ONCE.velocity_time_constant_s
    vehicles = Vehicles([START], AT_ONCE)
    setpoint = np.array([[0.6, -0.3]])
    for k in range(1, 9):
        vehicles.step(setpoint, NO_YAW, 0.1)
        t = 0.1 * k
        np.testing.assert_allclose(vehicles.velocity[0, :2], setpoint[0] * (1 - math.exp(-t / tau)), atol=1e-12)
        travelled = setpoint[0] * (t - tau * (1 - math.exp(-t / tau)))
        np.testing.assert_allclose(vehicles.position[0], [*(np.array([1.0, 2.0]) + travelled), -4.0], atol=2e-4)
    assert vehicles.velocity[0, 2] == 0.0


def test_a_large_change_is_limited_by_acceleration() -> None:
    vehicles = Vehicles([START], AT_ONCE)
    vehicles.step(np.array([[6.0, 8.0]]), NO_YAW, 1.0)
    np.testing.assert_allclose(vehicles.velocity[0], [2.4, 3.2, 0.0])
    np.testing.assert_allclose(vehicles.position[0], [1 + 1.2, 2 + 1.6, -4.0])


def test_it_is_flown_by_its_estimate_and_so_truly_flies_otherwise() -> None:
    """An autopilot that believes to fly what it is asked for, at the height and heading, does not; a person does."""
    sensors = SensorConfig(velocity_error_time_s=1e6, barometer_drift_m=1.0, barometer_drift_time_s=30.0)
    starts = [START, START.model_copy(update={"by_hand": True})]
    vehicles = Vehicles(starts, AT_ONCE, seed=3, sensors=sensors)
    for _ in range(200):
        vehicles.step(np.tile([1.0, 0.0], (2, 1)), np.zeros(2), 0.05, np.full(2, 4.0))
    errors = vehicles.errors[0]
    np.testing.assert_allclose(vehicles.velocity[0, :2], [1.0, 0.0] - errors.velocity[:2], atol=0.01)
    np.testing.assert_allclose(vehicles.known_velocity[0, :2], [1.0, 0.0], atol=0.01)
    yaw_deg = _yaw_pitch_roll_deg(vehicles.R_ned_body[0])[0]
    assert yaw_deg == pytest.approx(-math.degrees(errors.attitude[2]), abs=0.2)
    np.testing.assert_allclose(vehicles.velocity[1, :2], [1.0, 0.0], atol=1e-6)
    assert -vehicles.position[1, 2] == pytest.approx(4.0, abs=0.01)
    assert abs(errors.height_m) > 0.02
    np.testing.assert_allclose(vehicles.known_position[0] - vehicles.position[0], [*errors.position, -errors.height_m])


def test_one_long_step_is_many_short_ones() -> None:
    long, short = (Vehicles([START], VehicleConfig(gust_m_s=0.3), seed=1) for _ in range(2))
    setpoint = np.array([[2.0, -1.0]])
    long.step(setpoint, np.array([2.0]), 0.5)
    for _ in range(5):
        short.step(setpoint, np.array([2.0]), 0.1)
    np.testing.assert_allclose(long.position, short.position, atol=1e-12)
    np.testing.assert_allclose(long.R_ned_body, short.R_ned_body, atol=1e-12)


def test_what_was_handed_out_does_not_change() -> None:
    vehicles = Vehicles([START], VehicleConfig())
    position, velocity, turn = vehicles.position, vehicles.velocity, vehicles.R_ned_body
    kept = [array.copy() for array in (position, velocity, turn)]
    vehicles.step(np.array([[1.0, 1.0]]), np.array([1.0]), 0.5)
    for array, copy in zip((position, velocity, turn), kept, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_yaw_turns_the_short_way_and_no_faster_than_allowed() -> None:
    vehicles = Vehicles([START], VehicleConfig(max_yaw_rate_deg_s=60.0), yaw_rad=math.radians(170))
    still = np.zeros((1, 2))
    vehicles.step(still, np.array([math.radians(-100)]), 0.5)  # 90 deg clockwise across south
    assert _yaw_pitch_roll_deg(vehicles.R_ned_body[0])[0] == pytest.approx(-160.0)
    for _ in range(10):
        vehicles.step(still, np.array([math.radians(-100)]), 0.5)
    assert _yaw_pitch_roll_deg(vehicles.R_ned_body[0])[0] == pytest.approx(-100.0, abs=0.01)


def test_thrust_carries_the_weight_and_accelerates() -> None:
    rng = np.random.default_rng(0)
    thrust, yaw = rng.uniform(-4, 4, (20, 2)), rng.uniform(-3, 3, 20)
    R_ned_body = attitude(thrust, yaw)
    force = np.column_stack([thrust, np.full(20, -9.81)])
    up = -R_ned_body[:, :, 2]
    np.testing.assert_allclose(up, force / np.linalg.norm(force, axis=1, keepdims=True), atol=1e-12)
    np.testing.assert_allclose([_yaw_pitch_roll_deg(R)[0] for R in R_ned_body], np.degrees(yaw))
    np.testing.assert_allclose(np.linalg.det(R_ned_body), 1.0)


def test_it_leans_into_the_air_that_comes_against_it() -> None:
    cruising = Vehicles([StartConfig(position_m=(0.0, 0.0, -3.0), velocity_m_s=(1.0, 0.0))], VehicleConfig())
    lean_deg = math.degrees(math.atan(0.3 / 9.81))
    assert _yaw_pitch_roll_deg(cruising.R_ned_body[0])[1] == pytest.approx(-lean_deg)
    cruising.step(np.array([[1.0, 0.0]]), NO_YAW, 1.0)
    assert _yaw_pitch_roll_deg(cruising.R_ned_body[0])[1] == pytest.approx(-lean_deg)
    windy = Vehicles([START], VehicleConfig(wind_m_s=(0.0, -5.0)))  # air that moves west: it leans east
    for _ in range(4):
        windy.step(np.zeros((1, 2)), NO_YAW, 0.5)
    assert _yaw_pitch_roll_deg(windy.R_ned_body[0])[2] == pytest.approx(math.degrees(math.atan(1.5 / 9.81)))
    np.testing.assert_allclose(windy.velocity, 0.0, atol=1e-12)


def test_gusts_add_the_velocity_they_are_configured_for() -> None:
    """Ten fields, with ten vehicles in each so far apart that they are pushed by themselves."""
    apart = [START.model_copy(update={"position_m": (float(north_m), 0.0, -5.0)}) for north_m in range(0, 5000, 500)]
    spread = []
    for seed in range(10):
        vehicles = Vehicles(apart, VehicleConfig(gust_m_s=0.3), seed=seed)
        for k in range(12):
            vehicles.step(np.ones((10, 2)), np.zeros(10), 1.0)
            if k >= 4:
                spread.append(vehicles.velocity[:, :2] - 1.0)
    assert np.std(spread) == pytest.approx(0.3, rel=0.06)
    assert abs(np.mean(spread)) < 0.03


def test_an_autopilot_without_errors_gives_true_values() -> None:
    perfect = SensorConfig(
        barometer_drift_m=0.0, barometer_noise_m=0.0, attitude_error_deg=0.0, velocity_error_m_s=0.0,
        heading_error_deg=0.0, position_error_m=0.0, turn_rate_noise_deg_s=0.0,
    )  # fmt: skip
    autopilot = SimulatedAutopilot(perfect, seed=0, drone=0)
    turn = rotation_from_euler(0.1, -0.2, 1.0)
    state = autopilot.read(3.5, np.array([1.0, 2.0, -4.0]), np.array([1.0, 0.5, 0.0]), turn)
    assert (state.time_s, state.height_m) == (3.5, 4.0)
    np.testing.assert_array_equal(state.R_ned_body, turn)
    assert state.velocity_ned is not None
    np.testing.assert_array_equal(state.velocity_ned, [1.0, 0.5, 0.0])


def test_an_autopilots_errors_are_as_large_as_configured() -> None:
    config = SensorConfig(
        barometer_drift_m=0.1,
        barometer_drift_time_s=100.0,
        barometer_noise_m=0.02,
        position_error_m=0.3,
        heading_error_deg=1.5,
    )
    position, velocity, level = np.array([0.0, 0.0, -4.0]), np.zeros(3), np.eye(3)
    heights, angles_deg, velocities, places = [], [], [], []
    for drone in range(400):
        autopilot = SimulatedAutopilot(config, seed=7, drone=drone)
        states = [autopilot.read(t, position, velocity, level) for t in (0.0, 0.5, 500.0)]
        heights.append([state.height_m - 4.0 for state in states])
        angles_deg.append(_yaw_pitch_roll_deg(states[2].R_ned_body))
        velocities.append([np.asarray(state.velocity_ned, dtype=float) for state in states[:2]])
        places.append(np.asarray(states[2].position, dtype=float))
    at_start, soon, late = np.std(heights, axis=0)
    assert at_start == pytest.approx(0.02, rel=0.15)  # noise alone
    assert soon == pytest.approx(math.sqrt(0.02**2 + 0.1**2 * (1 - math.exp(-0.01))), rel=0.15)
    assert late == pytest.approx(math.hypot(0.1, 0.02), rel=0.15)
    np.testing.assert_allclose(np.std(angles_deg, axis=0), [1.5, 0.2, 0.2], rtol=0.15)
    assert np.std(velocities) == pytest.approx(0.1, rel=0.1)
    np.testing.assert_allclose(np.std(places, axis=0), 0.3, rtol=0.15)
    changes = np.diff(np.array(velocities), axis=1)
    assert np.std(changes) == pytest.approx(0.1 * math.sqrt(2 * (1 - math.exp(-0.5 / 2.0))), rel=0.1)  # slow


def test_an_autopilots_errors_depend_on_seed_and_drone_alone() -> None:
    def heights(seed: int, drone: int) -> list[float]:
        autopilot = SimulatedAutopilot(SensorConfig(), seed=seed, drone=drone)
        return [autopilot.read(t, np.zeros(3), np.zeros(3), np.eye(3)).height_m for t in (0.0, 0.5, 1.0)]

    assert heights(3, 1) == heights(3, 1)
    assert heights(3, 1) != heights(3, 2)
    assert heights(3, 1) != heights(4, 1)


def test_five_with_exact_states_become_the_pentagon() -> None:
    """Sides 2.47 m, diagonals 4.00 m, and the paper's convergence error of obj2 for its ground-truth run, 0.0206."""
    five = make.scenario({"ideal": True})
    times, positions, velocities = fly_exact_states(five, gated=False)
    assert positions.shape == velocities.shape == (220, 5, 3)
    np.testing.assert_allclose(times[[0, 1, -1]], [0.0, 0.5, 109.5])
    np.testing.assert_array_equal(positions[0], [start.position_m for start in five.vehicles])
    distances = np.sort(pair_distances(positions[-1, :, :2])[np.triu_indices(5, 1)])
    np.testing.assert_allclose(distances[:5], 2.47, atol=0.03)
    np.testing.assert_allclose(distances[5:], 4.00, atol=0.03)
    sums = np.array(
        [obj2(p[:, :2], v[:, :2], FlockingParameters()).sum() for p, v in zip(positions, velocities, strict=True)]
    )[times >= 100]
    assert np.abs(sums - sums.mean()).mean() < 0.0206
    assert sums.mean() == pytest.approx(15.27, abs=0.01)
    assert min(min_distance(step) for step in positions) > 1.19  # the start itself is the narrowest: 1.08 m, 0.5 m up
