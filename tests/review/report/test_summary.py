"""The summary of a small hand-made flight, every figure of which is worked out by hand, and the log it comes from."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.messages import SizeStatus
from flockd.review.flight_log.builder import FlightLogBuilder, match_neighbours
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import FleetMetadata, FlightMetadata, HandedOver, LearnedSize, MissionMetadata
from flockd.review.report.page_texts import page_texts
from flockd.review.report.summary import causes_text, sizes_text, summarise
from tests import make

Array = NDArray[np.float64]
STEPS, DRONES = 30, 2
TIME_S = np.arange(0.0, 15.0, 0.5)
HEADING_EAST = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _turn(axis: str, degrees: float) -> Array:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turns = {
        "yaw": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        "pitch": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "roll": [[1, 0, 0], [0, c, -s], [0, s, c]],
    }
    return np.array(turns[axis])


def flight_metadata(**changes: Any) -> FlightMetadata:
    """Of the hand-made flight, but for the changes."""
    drone = make.scenario().drone
    facts = {
        "scenario": "side_by_side", "perception": "learned", "flow": "dis", "drones": DRONES, "duration_s": 15.0,
        "seed": 3, "wall_s": 60.0, "circle_until_s": 2.0,
    }  # fmt: skip
    return FlightMetadata.of_configuration(drone, **{**facts, **changes})


def _hand_made() -> FlightLog:
    """15 s: two drones fly north at 1 m/s side by side, noses to the east; the circle "ends" at 2 s.

    The eastern one is 4 m away, 0.6 m at t = 1 s, and from 5 s on 4.01 and 3.99 m by turns. The western one drifts
    0.3 m/s eastward by its velocity until 3 s. Exact states: 3.9 m, no drift.
    """
    position = np.zeros((STEPS, DRONES, 3))
    position[:, :, 0] = TIME_S[:, None]
    position[:, 1, 1] = 4.0
    position[2, 1, 1] = 0.6
    position[10:, 1, 1] += np.where(np.arange(10, STEPS) % 2, 0.01, -0.01)
    position[:, :, 2] = [-3.0, -3.5]
    velocity = np.zeros((STEPS, DRONES, 3))
    velocity[..., 0] = 1.0
    truth_velocity = velocity.copy()
    velocity[TIME_S < 3.0, 0, 1] = 0.3
    truth_position = position.copy()
    truth_position[:, 1, 1] = 3.9

    ego_translation = np.full((STEPS, DRONES, 3), np.nan)
    moved = np.diff(position, axis=0)
    ego_translation[1:] = np.stack([moved[..., 1], -moved[..., 0], moved[..., 2]], axis=-1)  # forward is east
    ego_translation[:, 0, 0] += 0.01
    ego_translation[:, 1, 0] -= 0.03
    ego_translation[10, 1, 1] += 0.2
    ego_rotation = np.full((STEPS, DRONES, 3, 3), np.nan)
    ego_rotation[1:, 0] = _turn("yaw", 1.5)
    ego_rotation[1:, 1] = _turn("pitch", -2.0)
    ego_rotation[20, 1] = _turn("roll", 3.0)

    neighbour_position = np.full((STEPS, DRONES, DRONES, 3), np.nan)
    relative = position[:, 1] - position[:, 0]
    neighbour_position[:, 0, 1] = relative + np.array([0.0, 0.1, 5.0])  # the height does not count
    neighbour_position[3:, 1, 0] = -relative[3:]
    false_tracks = np.zeros((STEPS, DRONES), dtype=np.int64)
    false_tracks[4, 0], false_tracks[9, 1] = 1, 1
    return FlightLog(
        time_s=TIME_S,
        position=position,
        velocity=velocity,
        attitude=np.broadcast_to(HEADING_EAST, (STEPS, DRONES, 3, 3)).copy(),
        desired=np.tile([1.0, 0.0], (STEPS, 1)),
        command_velocity=velocity[..., :2],
        ego_rotation=ego_rotation,
        ego_translation=ego_translation,
        own_velocity_estimate=velocity,
        neighbour_position=neighbour_position,
        neighbour_velocity=np.full((STEPS, DRONES, DRONES, 3), np.nan),
        false_tracks=false_tracks,
        truth_position=truth_position,
        truth_velocity=truth_velocity,
        stages_ms={"flow": np.arange(1.0, 102.0), "never run": np.empty(0)},
        metadata=flight_metadata(),
    )


def _first(log: FlightLog, steps: int) -> FlightLog:
    cut = {
        name: getattr(log, name)[:steps] for name in log.__dataclass_fields__ if name not in ("stages_ms", "metadata")
    }
    return replace(log, **cut, metadata=log.metadata.model_copy(update={"duration_s": 0.5 * steps}))


def test_table_2_by_hand() -> None:
    table = summarise(_hand_made())["table2"]
    before, after = table["before"], table["after"]  # 3 intervals end before 2 s, 26 from then on
    assert before["translation_x_m"] == pytest.approx({"mean": 0.02, "median": 0.02, "p95": 0.03, "max": 0.03})
    assert before["translation_y_m"]["max"] == pytest.approx(0.0, abs=1e-12)
    assert after["translation_y_m"]["max"] == pytest.approx(0.2)
    assert after["translation_y_m"]["mean"] == pytest.approx(0.2 / 52)
    # Half of the angles are 1.5 or 2 deg, the others' are 0.
    assert before["yaw_deg"] == pytest.approx({"mean": 0.75, "median": 0.75, "p95": 1.5, "max": 1.5})
    assert before["pitch_deg"] == pytest.approx({"mean": 1.0, "median": 1.0, "p95": 2.0, "max": 2.0})
    assert before["roll_deg"]["max"] == pytest.approx(0.0, abs=1e-12)
    assert after["pitch_deg"]["mean"] == pytest.approx(2.0 * 25 / 52)
    assert after["roll_deg"]["max"] == pytest.approx(3.0)
    # Drone 1 is 0.1 m too far at 4 steps; the other way it is exact, seen at one of them.
    assert before["distance_m"] == pytest.approx({"mean": 0.08, "median": 0.1, "p95": 0.1, "max": 0.1})
    assert after["distance_m"]["mean"] == pytest.approx(0.05)


def test_angles_are_those_of_the_estimate_after_undoing_the_truth() -> None:
    """Both drones really turn 90 degrees at t = 1 s: an error made about C's axes then reads as it was made."""
    log = _hand_made()
    attitude = log.attitude.copy()
    attitude[2:] = attitude[2:] @ _turn("yaw", 90.0)
    ego_rotation = np.full_like(log.ego_rotation, np.nan)
    ego_rotation[2] = _turn("roll", 1.0) @ _turn("yaw", 90.0)
    table = summarise(replace(log, attitude=attitude, ego_rotation=ego_rotation))["table2"]["before"]
    assert table["roll_deg"]["max"] == pytest.approx(1.0)
    assert table["pitch_deg"]["max"] == pytest.approx(0.0, abs=1e-9)


def test_table_3_by_hand() -> None:
    """Sums in the tail, from 5 s on: obj1 0; obj2 2 |3.5 - 4| +- 0.02 by sight, 2 |3.5 - 3.9| with exact states."""
    table = summarise(_hand_made())["table3"]
    assert table["vision"]["obj1"] == pytest.approx({"time_s": 3.0, "error": 0.0, "shape_bias": 0.0})
    assert table["vision"]["obj2"] == pytest.approx({"time_s": 3.0, "error": 0.02, "shape_bias": 0.2})
    # -0.5 each on the circle, so obj1 cannot have converged before its end.
    assert table["truth"]["obj1"] == pytest.approx({"time_s": 2.0, "error": 0.0, "shape_bias": 0.0})
    assert table["truth"]["obj2"] == pytest.approx({"time_s": 0.0, "error": 0.0, "shape_bias": 0.0}, abs=1e-12)
    none = np.empty((0, DRONES, 3))  # no companion, no truth and no bias
    table = summarise(replace(_hand_made(), truth_position=none, truth_velocity=none))["table3"]
    assert table["truth"]["obj2"] == {"time_s": None, "error": None, "shape_bias": None}
    assert table["vision"]["obj2"] == {"time_s": 3.0, "error": pytest.approx(0.02), "shape_bias": None}


def test_a_sum_that_leaves_its_band_at_the_last_step_has_not_converged() -> None:
    log = _hand_made()
    position = log.position.copy()
    position[-1, 1, 1] = 5.0
    table = summarise(replace(log, position=position))["table3"]["vision"]
    assert table["obj2"]["time_s"] is None
    assert table["obj2"]["error"] == pytest.approx(2 * 19 / 20 * 2 * 1.0 / 20, rel=0.05)  # one of 20 is 2 off the rest


def test_drones_that_pass_between_two_steps_are_as_near_as_they_were() -> None:
    """At 2 m/s each, 0.34 m aside: 0.996 m apart at 12 s, and 2 m farther on their ways at 12.5 s."""
    log = _hand_made()
    position = log.position.copy()
    position[:, 0] = [0.0, 0.0, -4.0]
    position[:, 1, 0] = math.sqrt(0.996**2 - 0.34**2) - 4.0 * (TIME_S - 12.0)
    position[:, 1, 1:] = [0.34, -4.0]
    passing = replace(log, position=position)
    assert np.linalg.norm(position[:, 0] - position[:, 1], axis=1).min() == pytest.approx(0.996)
    flock = summarise(passing)["flock"]
    assert (flock["min_distance_m"], flock["min_distance_after_10s_m"]) == pytest.approx((0.34, 0.34))
    assert summarise(_first(passing, 25))["flock"]["min_distance_m"] == pytest.approx(0.996)  # ends at 12 s


def test_the_flocks_figures_by_hand() -> None:
    flock = summarise(_hand_made())["flock"]
    assert flock["min_distance_m"] == pytest.approx(math.hypot(0.6, 0.5))
    assert flock["min_distance_after_10s_m"] == pytest.approx(math.hypot(3.99, 0.5))
    assert (flock["order_tail"], flock["union_tail"]) == pytest.approx((1.0, 1.0))
    assert flock["safety"] == pytest.approx(29 / 30)  # nearer than 1 m at one step
    # Of drones that stand still, what is left of a velocity points anywhere.
    log = _hand_made()
    assert summarise(replace(log, velocity=0.099 * log.velocity))["flock"]["order_tail"] is None
    assert summarise(replace(log, velocity=0.101 * log.velocity))["flock"]["order_tail"] == pytest.approx(1.0)
    with warnings.catch_warnings():  # two drones that want to fly at each other want to stand still in the mean
        warnings.simplefilter("error")
        assert summarise(replace(log, desired=np.zeros_like(log.desired)))["flock"]["union_tail"] == 1.0


@pytest.mark.parametrize(
    ("changes", "recall", "false"),
    [
        ({}, 57 / 60, 2),
        ({"position": (np.s_[:15, 1, 1], 10.5)}, 1.0, 2),  # beyond ten metres they do not count
        ({"position": (np.s_[:15, 1, 1], 9.9)}, 57 / 60, 2),
        ({"false_tracks": (np.s_[4, 0], 3)}, 57 / 60, 4),  # each of a step counts
        ({"command_velocity": (np.s_[:], np.nan)}, None, None),  # no step was recorded
    ],
)
def test_neighbours_by_hand(changes: dict[str, Any], recall: float | None, false: int | None) -> None:
    log = _hand_made()
    for name, (where, value) in changes.items():
        array = getattr(log, name).copy()
        array[where] = value
        log = replace(log, **{name: array})
    neighbours = summarise(log)["neighbours"]
    assert neighbours["recall_within_10m"] == pytest.approx(recall)
    assert neighbours["false_per_drone_minute"] == pytest.approx(None if false is None else false / (2 * 0.25))


def test_every_track_near_a_drone_counts_with_its_error_and_any_other_as_false() -> None:
    """drone2 is 4 m away, tracked 2.5 m too far, which recall does not count, and every other step a ghost."""
    log = _hand_made()
    steps = np.arange(12, 30)
    relative = (log.position[:, 1] - log.position[:, 0])[steps]
    far = relative * (1 + 2.5 / np.linalg.norm(relative, axis=1, keepdims=True))
    ghosts = np.array([(step, 0, 9, -20.0, 0.0, 0.0) for step in steps[::2]])
    tracked = np.vstack([ghosts, np.column_stack([steps, 0 * steps, 0 * steps + 1, far])])
    neighbours = summarise(replace(log, tracked=tracked))["neighbours"]
    assert neighbours["associated_error_m"] == pytest.approx(dict.fromkeys(("mean", "median", "p95", "max"), 2.5))
    assert neighbours["false_share"] == pytest.approx(9 / 60), "the far one is a wrong distance, not a false neighbour"
    first = summarise(replace(log, tracked=tracked[9:]))["neighbours"]
    assert first["false_share"] == 0.0


def test_a_flight_with_exact_states_has_no_estimates_and_is_the_truth() -> None:
    log = _hand_made()
    summary = summarise(replace(log, metadata=log.metadata.model_copy(update={"perception": "truth"})))
    nothing = dict.fromkeys(("mean", "median", "p95", "max"))
    assert all(column == nothing for window in summary["table2"].values() for column in window.values())
    assert set(summary["neighbours"].values()) == {None}
    assert summary["table3"]["truth"]["obj2"] == pytest.approx({"time_s": 3.0, "error": 0.02, "shape_bias": 0.0})
    assert summary["table3"]["vision"]["obj1"] == {"time_s": None, "error": None, "shape_bias": None}


@pytest.mark.parametrize("steps", [1, 3, 20])
def test_what_a_short_flight_cannot_tell_is_null(steps: int) -> None:
    summary = summarise(_first(_hand_made(), steps))
    assert summary["table3"]["vision"]["obj1"] == {"time_s": None, "error": None, "shape_bias": None}
    assert summary["flock"]["min_distance_after_10s_m"] is None
    assert summary["flock"]["order_tail"] == pytest.approx(1.0, abs=0.05)  # of the whole flight
    if steps <= 4:
        assert summary["table2"]["after"]["distance_m"] == dict.fromkeys(("mean", "median", "p95", "max"))
    json.dumps(summary, allow_nan=False)


def test_a_log_survives_its_file(tmp_path: Path) -> None:
    log = _hand_made()
    path = tmp_path / "flight.npz"
    log.save(path)
    loaded = FlightLog.load(path)
    assert loaded.metadata == log.metadata
    assert loaded.stages_ms.keys() == log.stages_ms.keys()
    np.testing.assert_array_equal(loaded.stages_ms["flow"], log.stages_ms["flow"])
    for name in log.__dataclass_fields__:
        if name not in ("stages_ms", "metadata"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(log, name))
    summary = summarise(loaded)
    assert summary == summarise(log) == json.loads(json.dumps(summary, allow_nan=False)), "strict JSON"
    assert (summary["realtime_factor"], summary["stages_ms"]) == (0.25, {"flow": {"p50": 51.0, "p95": 96.0}})


def test_metadata_of_a_fleet_comes_back() -> None:
    fleet = FleetMetadata(
        speed_factor=0.5, frame_sets=4, longest_step_s=1.0, order_last_20s=math.nan,
        handed_over={"drone1": "it landed"}, exit_codes={"drone1": 0}, notes=["a note"],
    )  # fmt: skip
    written = flight_metadata(fleet=fleet, seed=None).model_dump_json(exclude_unset=True)
    assert json.loads(written)["seed"] is None
    assert "recorded" not in json.loads(written)
    again = FlightMetadata.model_validate_json(written).fleet
    assert again is not None
    assert math.isnan(again.order_last_20s)
    assert again.handed_over == {"drone1": "it landed"}


def test_a_log_refuses_what_does_not_fit(tmp_path: Path) -> None:
    log = _hand_made()
    with pytest.raises(ValueError, match="desired"):
        replace(log, desired=log.desired[:-1])
    with pytest.raises(ValueError, match="truth_position"):
        replace(log, truth_position=log.truth_position[:-1])
    path = tmp_path / "other.npz"
    np.savez(path, time_s=TIME_S)
    with pytest.raises(ValueError, match="not a flight log"):
        FlightLog.load(path)


def test_estimates_are_matched_to_the_nearest_drone_one_to_one() -> None:
    true = np.array([[4.0, 0.0, 0.0], [4.0, 1.5, 0.0], [0.0, 16.0, 0.0]])
    estimated = np.array([[4.0, 0.9, 0.0], [4.0, 1.4, 0.0], [0.0, 12.5, 0.0], [-3.0, 0.0, 0.0]])
    # The first is nearer to drone 1, which the second has; the third is 3.5 m off, within a quarter of 16 m.
    assert match_neighbours(estimated, true) == [(0, 0), (1, 1), (2, 2)]
    assert match_neighbours(np.array([[4.0, -1.01, 0.0]]), true[:1]) == []  # beyond 1 m
    assert match_neighbours(np.array([[0.0, 11.9, 0.0]]), true[2:]) == []  # beyond a quarter
    assert match_neighbours(np.empty((0, 3)), true) == []
    assert match_neighbours(estimated, np.empty((0, 3))) == []


def test_a_mission_has_arrived_where_the_middle_is_at_the_last_goal() -> None:
    goal = np.full((STEPS, 2), np.nan)
    goal[2:10], goal[10:] = [5.0, 2.0], [12.0, 2.0]
    log = _hand_made()
    mission = MissionMetadata(kind="waypoints", reached_m=1.2)
    log = replace(log, goal=goal, metadata=log.metadata.model_copy(update={"mission": mission}))
    # The middle flies north along 2 m east: at 11 s it is 1 m from the goal, and at 14.5 s, the end, 2.5 m beyond it.
    figures = summarise(log)["mission"]
    assert figures == {
        "kind": "waypoints",
        "who": "the middle",
        "arrived": False,
        "time_s": 11.0,
        "final_error_m": pytest.approx(2.5, abs=0.01),
    }
    arrived = summarise(_first(log, 26))["mission"]  # to 12.5 s
    assert (arrived["arrived"], arrived["time_s"]) == (True, 11.0)
    before = summarise(_first(log, 12))["mission"]
    assert (before["arrived"], before["time_s"]) == (False, None)
    landed = replace(log, goal=np.where(np.arange(STEPS)[:, None] < 24, goal, np.nan))  # over after 11.5 s
    over = summarise(landed)["mission"]
    assert (over["arrived"], over["time_s"]) == (True, 11.0)
    assert over["final_error_m"] == pytest.approx(0.5, abs=0.01)
    # At 11 s the middle was 1 m from there already; until the order at 11.5 s there was no goal.
    ordered = np.where(np.arange(STEPS)[:, None] < 23, np.nan, [12.0, 2.0])
    assert summarise(replace(log, goal=ordered))["mission"]["time_s"] == 11.5
    nowhere = summarise(_hand_made())["mission"]
    assert (nowhere["arrived"], nowhere["time_s"], nowhere["final_error_m"]) == (None, None, None)


def test_where_a_person_leads_it_is_the_persons_drone_that_arrives() -> None:
    """The first drone is at the goal at the end, the flock's middle 2 m beside it."""
    scenario = make.scenario(name="led_by_hand")
    assert MissionMetadata.of(scenario.missions).led_by == 0
    knowing = make.scenario(name="one_knows")
    assert MissionMetadata.of(knowing.missions).led_by is None
    log = _hand_made()
    goal = np.tile(log.position[-1, 0, :2] + [0.1, 0.0], (STEPS, 1))
    for led_by, arrived in ((0, True), (None, False)):
        mission = MissionMetadata(kind="waypoints by hand, follow", reached_m=0.5, led_by=led_by)
        flown = replace(log, goal=goal, metadata=log.metadata.model_copy(update={"mission": mission}))
        assert summarise(flown)["mission"]["arrived"] is arrived


def test_a_contact_with_an_obstacle_counts_once_however_long_it_lasts() -> None:
    clearance = np.full((STEPS, DRONES), 5.0)
    clearance[3:6, 0] = 0.2, 0.1, 0.34
    clearance[8, 0] = 0.3
    clearance[9:12, 1] = 1.2
    log = _hand_made()
    assert set(summarise(log)["obstacles"].values()) == {None}
    among = replace(log, clearance=clearance, metadata=log.metadata.model_copy(update={"drone_radius_m": 0.35}))
    assert summarise(among)["obstacles"] == {
        "collisions": 2,
        "min_clearance_m": pytest.approx(0.1 - 0.35),
        "time_within_1m_s": pytest.approx(7 * 0.5),
    }


def test_what_happens_once_flockd_does_not_fly_any_more_counts_apart() -> None:
    """Nearest is 0.78 m, in three dimensions, at 1 s; one drone is held since 0.9 s, then both."""
    log, held = _hand_made(), {1: HandedOver(time_s=0.9, reason="gusts")}
    of_one = summarise(replace(log, metadata=log.metadata.model_copy(update={"handed_over": held})))["handed_over"]
    assert (of_one["drones"], of_one["first_s"], of_one["reasons"]) == (1, 0.9, ["gusts"])
    assert of_one["min_distance_flown_m"] == pytest.approx(math.hypot(0.6, 0.5))
    both = held | {0: HandedOver(time_s=0.2, reason="gusts")}
    of_both = summarise(replace(log, metadata=log.metadata.model_copy(update={"handed_over": both})))["handed_over"]
    assert of_both["first_s"] == 0.2
    assert of_both["min_distance_flown_m"] > 0.78, "from 0.5 s to 1 s, in whose step both were handed over, counts"
    of_none = summarise(log)["handed_over"]
    assert (of_none["drones"], of_none["first_s"], of_none["collisions_flown"]) == (0, None, None)


def test_what_gates_slowed_drones_down_for_and_what_they_learned_of_sizes_is_told() -> None:
    log, by_cause = _hand_made(), {"neighbour": 0.011, "wind": 0.0009}
    sizes = {0: LearnedSize(since_s=12.0, size_m=0.43, sigma=0.07)}
    facts = {"gated": True, "slowed_share": 0.03, "slowed_by": by_cause, "sizes": sizes}
    summary = summarise(replace(log, metadata=log.metadata.model_copy(update=facts)))
    assert causes_text(summary) == "neighbours 1.1 %, wind 0.1 %"
    assert sizes_text(summary) == "0.43 to 0.43 m, by 1 of 2 drones"
    told, before = ({one["name"]: one for one in page_texts(of, log)["facts"]} for of in (summary, summarise(log)))
    assert told.keys() - before.keys() == {"Slowed", "Size learned"}
    assert (told["Size learned"]["value"], told["Size learned"]["unit"]) == ("0.43 to 0.43", "m")


def test_the_log_keeps_what_was_learned_last_and_since_when() -> None:
    builder = FlightLogBuilder(np.array([0.0, 0.5, 1.0]), 1)
    sizes = (SizeStatus(weaves=True), SizeStatus(True, 0.46, 0.09), SizeStatus(False, 0.43, 0.07))
    for step, size in enumerate(sizes):
        builder.add_output(step, 0, make.output(0.5 * step, size=size), {})
    kept = builder.build(_hand_made().metadata, None).metadata.sizes
    assert kept == {0: LearnedSize(since_s=0.5, size_m=0.43, sigma=0.07)}
