"""The catalogue of faults: each has a row, a name, and the stories that inject it. `python -m tools.checks.faults`
runs them.

A story is a test; most start a whole drone (`tests.faults.process`). It notes how long the reaction took with
`reacted`, and asserts what the row promises beside it: the event that is reported, and how it goes on afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

RecordProperty = Callable[[str, object], None]
"""pytest's fixture `record_property`."""
REACTION = "reaction_s of "
"""A property of a test's report begins with this, and goes on with the fault's name."""


@dataclass(frozen=True)
class Fault:
    """One row."""

    row: int
    name: str
    """For `--only`."""
    fault: str
    reaction: str
    stories: tuple[str, ...]
    """Ids of tests."""
    within_s: float | None = None
    """The longest reaction; None where the reaction is not a matter of time."""


def reacted(record: RecordProperty, name: str, seconds: float) -> None:
    """Notes how long the reaction to a fault took; an assertion fails when that was too long."""
    limit_s = fault_named(name).within_s
    record(f"{REACTION}{name}", round(seconds, 3))
    assert limit_s is not None, f"{name} is not a matter of time"
    assert 0.0 <= seconds <= limit_s, f"the reaction to {name} took {seconds:.2f} s"


def fault_named(name: str) -> Fault:
    """The fault of this name. Raises KeyError."""
    for fault in CATALOGUE:
        if fault.name == name:
            return fault
    raise KeyError(name)


_HERE = "tests/faults/test_"
_PX4 = "tests/sitl/test_px4_modes.py::test_px4_ends_in_the_mode_that_its_parameters_promise"
"""With PX4 alone: skipped where FLOCKD_PX4 names none. So the next with `px4`."""
_CONTRACT = "tests/sitl/test_autopilot_contract.py::test_flockd_sees_what_px4_1_18_shows"
_LINK = "tests/onboard/autopilot/test_link.py"
_SERIAL = "tests/onboard/autopilot/test_serial_link.py"

# fmt: off
CATALOGUE = (
    Fault(
        1, "camera-unplugged", "no camera delivers images any more",
        "hover for a second at most, then Hold; no return by itself",
        (
            f"{_HERE}cameras.py::test_no_camera_delivers_any_more",
            "tests/onboard/sources/test_v4l2.py::test_an_unplugged_camera_is_reported_at_once_and_comes_back_when_plugged_in",
            "tests/onboard/sources/test_gstreamer.py::test_a_crash_is_followed_by_images_when_the_driver_is_back",
            "tests/onboard/sources/test_ros_topics.py::test_a_silent_topic_is_opened_again",
        ),
        within_s=3.0,
    ),
    Fault(
        2, "frozen-frames", "the same image or number again and again", "as for a camera that is unplugged",
        (
            f"{_HERE}cameras.py::test_all_cameras_freeze",
            "tests/onboard/sources/test_v4l2.py::test_a_frozen_camera_counts_as_silent",
            "tests/onboard/sources/test_gstreamer.py::test_a_frozen_pipeline_counts_as_silent",
        ),
        within_s=3.0,
    ),
    Fault(
        3, "damaged-images", "corrupt or truncated images", "dropped and counted; degraded above a fifth",
        (
            f"{_HERE}cameras.py::test_images_are_damaged",
            "tests/onboard/sources/test_v4l2.py::test_what_is_worth_nothing_is_dropped_and_counted_and_the_next_is_fine",
            "tests/onboard/sources/test_gstreamer.py::test_what_is_worth_nothing_is_dropped_and_counted_and_the_next_is_fine",
            "tests/onboard/sources/test_ros_topics.py::test_what_is_worth_nothing_is_counted_and_the_next_is_fine",
        ),
        within_s=6.0,
    ),
    Fault(
        4, "time-stamps-backwards", "time stamps are repeated or run backwards", "dropped and counted; degraded",
        (
            f"{_HERE}cameras.py::test_time_stamps_are_repeated_and_run_backwards",
            "tests/flight/pilot/test_flock_pilot.py::test_a_repeated_time_stamp_restarts_the_pair_and_says_so",
        ),
        within_s=5.0,
    ),
    Fault(
        5, "one-camera-gone", "one of several cameras is gone", "fly on with the others, degraded, and say so",
        (
            f"{_HERE}cameras.py::test_one_of_two_cameras_is_gone_and_comes_back",
        ),
        within_s=2.0,
    ),
    Fault(
        6, "network-not-finite", "a network's output is not finite",
        "the camera or the proposal is left out of the step, and counted; degraded",
        (
            "tests/onboard/daemon/test_flight.py::test_networks_not_finite_or_stuck_degrade_and_sigterm_ends_in_hold",
            "tests/flight/pilot/test_flock_pilot.py::test_an_output_that_is_not_finite_costs_its_frame_only",
            "tests/flight/pilot/test_flock_pilot.py::test_a_flow_that_is_not_finite_costs_its_camera_only",
            "tests/flight/pilot/test_flock_pilot.py::test_a_range_that_is_not_finite_costs_its_proposal_only",
            f"{_HERE}computer.py::test_a_networks_output_is_not_finite",
        ),
        within_s=2.0,
    ),
    Fault(
        7, "model-changed", "a model file is missing or changed", "refuse to start with exit code 78",
        (
            f"{_HERE}start.py::test_a_model_was_changed",
            "tests/flight/inference/test_refusals.py::test_a_start_with_a_damaged_model_ends_with_one_sentence",
        ),
        within_s=15.0,
    ),
    Fault(
        8, "network-stuck", "a network does not return", "end the run, then abandon it, then the watchdog acts",
        (
            f"{_HERE}computer.py::test_a_network_never_returns",
            "tests/onboard/daemon/test_parts.py::test_a_stuck_network_is_ended_then_abandoned_then_hopeless",
        ),
        within_s=2.0,
    ),
    Fault(
        9, "overrun", "steps take too long, or the computer is too hot", "newest frame only, slower, then Hold",
        (
            f"{_HERE}computer.py::test_steps_take_longer_than_they_may",
            f"{_HERE}computer.py::test_it_gets_too_hot",
        ),
        within_s=8.0,
    ),
    Fault(
        10, "event-loop-stuck", "the event loop is stuck", "setpoints stop within 0.5 s; the watchdog is not fed",
        (
            f"{_HERE}computer.py::test_the_event_loop_is_stuck",
            "tests/cli/test_run.py::test_a_stall_of_the_computer_ends_in_the_autopilots_failsafe_and_is_named",
            "tests/onboard/daemon/test_flight.py::test_a_blocked_event_loop_is_silence_and_the_autopilots_failsafe",
        ),
        within_s=0.5,
    ),
    Fault(
        11, "task-dies", "a task of the daemon dies", "Hold, and an exit code that is not zero",
        (
            f"{_HERE}computer.py::test_a_task_dies",
            "tests/onboard/daemon/test_flight.py::test_a_dead_task_is_held_by_the_last_resort",
        ),
        within_s=2.0,
    ),
    Fault(
        12, "link-lost", "the autopilot is not heard any more",
        "silence; no offboard flight by itself when it is back",
        (
            f"{_HERE}autopilot.py::test_the_link_is_lost_and_comes_back",
            f"{_PX4}[link_lost]",
        ),
        within_s=3.5,
    ),
    Fault(
        13, "pilot-takes-over", "the pilot changes the flight mode", "silence at once; never back by itself",
        (
            f"{_HERE}autopilot.py::test_the_pilot_takes_over",
            f"{_PX4}[rc_override]",
        ),
        within_s=0.3,
    ),
    Fault(
        14, "offboard-refused", "the pilot's offboard mode is refused", "the reason is reported",
        (
            f"{_HERE}autopilot.py::test_offboard_is_refused_and_the_whole_reason_reported",
        ),
        within_s=2.0,
    ),
    Fault(
        15, "battery-or-estimate", "the battery is low, or the estimate or the satellites are lost",
        "leave the flock: Hold, or as configured",
        (
            f"{_HERE}autopilot.py::test_the_battery_is_low_or_the_position_lost",
            "tests/onboard/daemon/test_flight.py::test_a_position_and_velocity_that_come_no_more_are_not_flown_by",
            f"{_PX4}[gps_off]",
            f"{_PX4}[estimator_lost]",
            f"{_PX4}[battery_low]",
        ),
        within_s=3.0,
    ),
    Fault(
        16, "neighbour-too-near", "a neighbour inside the minimum distance, or closing too fast",
        "separation wins; never faster than can be braked",
        (
            f"{_HERE}flock.py::test_a_neighbour_comes_too_near",
            f"{_HERE}encounters.py::test_two_drones_that_meet_head_on_stay_apart[1.5]",
            "tests/flight/safety/test_gate.py::test_two_that_fly_at_each_other_at_3_m_s_stop_before_the_minimum_distance",
        ),
        within_s=1.5,
    ),
    Fault(
        17, "alone", "all neighbours are lost", "fly on as desired for a while, then Hold; no old track is followed",
        (
            f"{_HERE}flock.py::test_all_neighbours_are_lost",
        ),
        within_s=6.0,
    ),
    Fault(
        18, "false-neighbour", "a drone is detected where there is none",
        "not confirmed before several hits; bounded influence",
        (
            "tests/flight/tracking/test_tracker.py::test_false_detections_of_one_frame_are_never_confirmed",
            "tests/flight/tracking/test_tracker.py::test_one_frame_three_metres_off_moves_a_confirmed_track_little",
        ),
    ),
    Fault(
        19, "command-not-finite", "a command that is not finite, or far too large", "refused, standstill, counted",
        (
            f"{_HERE}flock.py::test_a_command_that_cannot_be_flown",
        ),
        within_s=1.0,
    ),
    Fault(
        20, "fence-left", "the fence or the band of heights is left", "inward velocity only, then Hold",
        (
            f"{_HERE}flock.py::test_the_fence_is_left",
            f"{_PX4}[geofence]",
        ),
        within_s=6.0,
    ),
    Fault(
        21, "telemetry-router-gone", "the router of the telemetry is gone", "fly on; drop",
        (
            f"{_HERE}outside.py::test_the_router_of_the_telemetry_goes_and_comes_back",
        ),
    ),
    Fault(
        22, "disk-full", "the disk is full", "stop recording, say so, fly on",
        (
            f"{_HERE}recording.py::test_the_disk_is_full",
            "tests/onboard/recording/test_recorder.py::test_a_full_disk_ends_the_recording_and_not_the_flight",
        ),
        within_s=5.0,
    ),
    Fault(
        23, "killed-while-recording", "the power is lost, or the process killed, while it records",
        "`record recover` brings back all but the last chunk",
        (
            f"{_HERE}recording.py::test_it_is_killed_while_it_records",
            "tests/onboard/recording/test_reader.py::test_a_kill_at_any_moment_loses_half_a_second_at_most",
        ),
        within_s=2.0,
    ),
    Fault(
        24, "clock-jump", "the wall clock is set", "nothing changes; a note",
        (
            f"{_HERE}computer.py::test_the_wall_clock_is_set",
        ),
    ),
    Fault(
        25, "wrong-configuration", "the configuration is wrong",
        "refuse to start with exit code 78: line, key, value, what to do",
        (
            f"{_HERE}start.py::test_the_configuration_is_wrong",
        ),
        within_s=30.0,
    ),
    Fault(
        26, "second-instance", "a second daemon for the same drone", "it refuses to start with exit code 69",
        (
            f"{_HERE}start.py::test_a_second_instance_is_started_in_flight",
        ),
        within_s=15.0,
    ),
    Fault(
        27, "sigterm", "SIGTERM in flight", "standstill, Hold within 2 s, the recording is closed, exit code 0",
        (
            f"{_HERE}recording.py::test_sigterm_in_flight",
        ),
        within_s=2.0,
    ),
    Fault(
        28, "out-of-memory", "the memory is used up in flight",
        "Hold, or the process ends and the autopilot's failsafe acts; a restart is idle",
        (
            f"{_HERE}computer.py::test_the_memory_is_used_up_in_flight",
            f"{_PX4}[daemon_killed]",
        ),
        within_s=6.0,
    ),
    Fault(
        29, "malformed-telemetry", "malformed messages on the telemetry bus",
        "ignored; commands only where configured",
        (
            f"{_HERE}outside.py::test_nonsense_on_the_telemetry_bus",
            "tests/onboard/telemetry/test_access.py::test_what_is_no_message_is_counted_and_not_taken",
        ),
    ),
    Fault(
        30, "noisy-camera", "a camera shows noise",
        "it counts as lost; no neighbour from it alone; the command stays within 0.1 m/s",
        (
            f"{_HERE}cameras.py::test_a_camera_shows_noise",
            "tests/onboard/daemon/test_flight.py::test_a_noisy_camera_is_lost_and_said_so_until_it_is_good_again",
            "tests/flight/pilot/test_noisy_camera.py",
        ),
        within_s=4.0,
    ),
    Fault(
        31, "absurd-mavlink", "a MAVLink message with unknown or absurd values", "the field is unknown and counted",
        (
            f"{_HERE}autopilot.py::test_messages_with_absurd_values",
            "tests/onboard/autopilot/test_link.py::test_a_landed_state_that_mavlink_does_not_have_is_unknown_and_counted",
        ),
    ),
    Fault(
        32, "home-moved", "home or the ground state changes in flight, by a second sender",
        "height band and fence stay until it is disarmed; reported",
        (
            "tests/onboard/daemon/test_flight.py::"
            "test_a_second_sender_with_the_autopilots_ids_moves_neither_height_band_nor_fence",
            "tests/onboard/autopilot/test_mavlink_messages.py::"
            "test_home_stays_while_armed_whatever_landed_state_and_home_say_and_moves_after",
        ),
    ),
    Fault(
        33, "time-stamps-jump", "a camera's time stamps jump ahead, back or to absurd values",
        "dropped and counted; good frames are used as soon as they return",
        (
            f"{_HERE}cameras.py::test_a_frame_of_another_time_silences_nobody",
        ),
        within_s=4.0,
    ),
    Fault(
        34, "foreign-recordings", "something foreign in the recordings' folder", "skipped with a warning; it records",
        (
            f"{_HERE}recording.py::test_foreign_things_lie_among_the_recordings",
            "tests/onboard/recording/test_recorder.py::test_what_is_no_readable_file_in_the_folder_is_skipped_with_a_warning",
        ),
    ),
    Fault(
        35, "endless-network", "a network that never ends", "refuse to start with exit code 78 within 10 s",
        (
            "tests/cli/test_run.py::test_a_network_that_never_ends_is_bad_configuration_within_ten_seconds",
            "tests/onboard/test_deadline.py::test_an_endless_network_is_refused_in_one_sentence",
        ),
    ),
    Fault(
        36, "hostile-manifest", "a hostile manifest", "exit code 78 within 2 s: line, key, value, what to do",
        (
            f"{_HERE}start.py::test_a_manifest_is_hostile",
            "tests/flight/inference/test_manifest_file.py",
        ),
        within_s=15.0,
    ),
    Fault(
        37, "hostile-recording", "a damaged or hostile recording", "one sentence, exit code 1, bounded memory",
        (
            f"{_HERE}files.py::test_a_recording_is_hostile",
            "tests/onboard/recording/test_reader.py::test_a_hostile_chunk_is_damage_and_takes_little_memory",
            "tests/onboard/recording/test_reader.py::test_damage_within_is_reported_and_recovered_from",
        ),
    ),
    Fault(
        38, "huge-image", "an image that claims to be 60000 x 60000", "one sentence, before memory is taken",
        (
            f"{_HERE}files.py::test_an_image_claims_to_be_huge",
            "tests/onboard/recording/test_reader.py::test_an_image_that_claims_to_be_huge_is_not_decoded",
        ),
    ),
    Fault(
        39, "wrong-types-of-a-peer", "telemetry of a peer with wrong types or control characters",
        "shown as malformed, escaped; `status` goes on",
        (
            f"{_HERE}outside.py::test_status_shows_a_peer_that_publishes_nonsense",
            "tests/onboard/telemetry/test_malformed.py",
        ),
    ),
    Fault(
        40, "simulator-killed", "the simulator, or who started a daemon in simulation, is killed",
        "its daemons and autopilots end with it",
        (
            f"{_HERE}simulator.py::test_the_simulator_is_killed_in_flight",
            "tests/sim/sitl/test_orphans.py",
        ),
        within_s=5.0,
    ),
    Fault(
        41, "text-in-chunks", "the autopilot's text comes in several messages", "joined before anyone sees it",
        (
            f"{_HERE}autopilot.py::test_offboard_is_refused_and_the_whole_reason_reported",
            "tests/onboard/autopilot/test_mavlink_messages.py::test_a_text_in_chunks_is_seen_whole_and_not_before",
        ),
    ),
    Fault(
        42, "nothing-left-at-start", "no file descriptors or memory are left at the start",
        "one sentence, exit code 69; never an abort",
        (
            f"{_HERE}computer.py::test_no_descriptors_are_left_at_the_start",
        ),
    ),
    Fault(
        43, "absurd-limits", "limits in the configuration beyond physics", "refuse to start with exit code 78",
        (
            f"{_HERE}start.py::test_the_configuration_is_wrong",
            "tests/flight/safety/test_parameters.py::test_limits_beyond_what_any_multirotor_does_are_refused",
        ),
    ),
    Fault(
        44, "one-spot", "two drones at one horizontal spot", "they part, each to its own right",
        (
            f"{_HERE}flock.py::test_two_drones_at_one_spot_part",
            "tests/flight/flocking/test_law.py::test_two_drones_at_one_level_spot_part_each_to_its_own_right",
        ),
    ),
    Fault(
        45, "computer-stalls", "the computer stalls for seconds",
        "the autopilot's failsafe; no return by itself; the event names the stall",
        (
            f"{_HERE}computer.py::test_the_computer_stalls_for_seconds",
            "tests/sitl/test_fleet.py::test_px4_enters_its_failsafe_when_its_daemon_is_frozen",
        ),
        within_s=0.5,
    ),
    Fault(
        46, "ground-reached", "the ground is reached in flight",
        "no depth scale, no exception; landing is recorded and reported",
        (
            f"{_HERE}autopilot.py::test_the_ground_is_reached_in_flight",
        ),
        within_s=6.0,
    ),
    Fault(
        47, "range-finder-lies", "the range finder is stuck, something hangs in its beam, or its readings jump",
        "the barometer's height is used, and an event says so; without it no scale, then Hold",
        (
            f"{_HERE}range_finder.py::test_the_range_finder_lies",
            f"{_HERE}range_finder.py::test_without_the_barometer_a_lie_is_no_scale_and_ends_in_hold",
            "tests/flight/pilot/ground/test_contradiction.py",
        ),
        within_s=3.0,
    ),
    Fault(
        48, "head-on", "two drones meet head-on", "at least 1.0 m apart at every instant",
        (
            f"{_HERE}encounters.py::test_two_drones_that_meet_head_on_stay_apart[2.0]",
            "tests/sim/flock/test_encounters.py",
        ),
    ),
    Fault(
        49, "one-that-does-not-avoid", "a drone that does not avoid stands in the way", "stopped 1.0 m before it",
        (
            f"{_HERE}encounters.py::test_a_drone_that_hovers_in_the_way_and_does_not_avoid_is_stopped_before",
        ),
    ),
    Fault(
        50, "gusts", "gusts up to the limit, and beyond it", "no contact; beyond: slower, then Hold with the reason",
        (
            f"{_HERE}encounters.py::test_gusts_up_to_the_limit_do_not_bring_two_drones_together",
            f"{_HERE}encounters.py::test_gusts_beyond_the_limit_end_in_hold_with_the_reason",
            "tests/flight/safety/test_response.py",
        ),
    ),
    Fault(
        51, "autopilot-obeys-late", "an autopilot that obeys late or weakly", "as for gusts",
        (
            f"{_HERE}encounters.py::test_two_drones_whose_autopilots_obey_a_little_late_and_weakly_stay_apart",
            f"{_HERE}encounters.py::"
            "test_an_autopilot_that_obeys_a_second_late_and_weakly_ends_in_hold_with_the_reason",
        ),
    ),
    Fault(
        52, "timesync-lies", "TIMESYNC jumps or creeps, or somebody else answers",
        "not used; an event; attitudes are no worse than by arrival",
        (
            f"{_HERE}autopilot.py::test_timesync_lies",
            "tests/onboard/autopilot/test_clock_sync.py::test_a_lying_timesync_is_not_used_and_said",
        ),
        within_s=5.0,
    ),
    Fault(
        53, "hostile-peers", "a peer's absurd numbers, endless texts, names by the thousand",
        "refused where it enters; drones stay visible, page and orders live on",
        (
            f"{_HERE}operators.py::test_neither_absurd_peers_nor_stuck_pictures_keep_an_order_from_a_drone",
            "tests/onboard/telemetry/test_malformed.py",
            "tests/fleet/page/test_crowded.py::test_a_drone_with_absurd_numbers_closes_no_page",
        ),
        within_s=60.0,
    ),
    Fault(
        54, "stuck-pictures", "pictures of drones that do not answer, many browsers, half-open connections",
        "an order to another drone is answered within a second",
        (
            f"{_HERE}operators.py::test_neither_absurd_peers_nor_stuck_pictures_keep_an_order_from_a_drone",
            "tests/fleet/page/test_crowded.py",
        ),
        within_s=1.0,
    ),
    Fault(
        55, "one-name-twice", "two drones of one name", "said on page and in status; no order is sent",
        (
            f"{_HERE}operators.py::test_orders_that_are_old_or_ambiguous_or_without_end",
            "tests/onboard/telemetry/test_malformed.py::"
            "test_two_drones_of_one_name_are_told_apart_by_identity_and_neither_gets_an_order",
        ),
        within_s=5.0,
    ),
    Fault(
        56, "order-replayed", "old, replayed or reordered orders, two operators",
        "refused, or the last one by time wins; both operators are named",
        (
            f"{_HERE}operators.py::test_orders_that_are_old_or_ambiguous_or_without_end",
            "tests/onboard/daemon/test_orders.py",
        ),
        within_s=3.0,
    ),
    Fault(
        57, "orders-without-end", "thousands of refused orders", "log and recording bounded, nothing displaced",
        (
            f"{_HERE}operators.py::test_orders_that_are_old_or_ambiguous_or_without_end",
            "tests/onboard/daemon/test_orders.py",
        ),
        within_s=3.0,
    ),
    Fault(
        58, "lens-covered", "a lens is covered, dirty, fogged or in the sun", "that camera counts as blind; said",
        (
            f"{_HERE}cameras.py::test_a_lens_is_covered",
            "tests/flight/perception/test_lens.py",
        ),
        within_s=8.0,
    ),
    Fault(
        59, "rig-off", "mountings, focal lengths or time stamps are not as configured",
        "warned with the estimated correction, three standard deviations off; never corrected unasked",
        (
            f"{_HERE}rig.py::test_a_rig_is_not_as_configured",
            f"{_HERE}rig.py::test_a_rig_as_configured_is_flown_without_a_word",
            "tests/flight/geometry/test_rig_calibration.py",
        ),
        within_s=20.0,
    ),
    Fault(
        60, "step-exception", "an exception that nobody expected in the pilot's step",
        "caught at the step's border; one step lost with its reason; three in a row: Hold",
        (
            f"{_HERE}computer.py::test_a_step_ends_in_an_error_that_nobody_expects",
        ),
        within_s=5.0,
    ),
    Fault(
        61, "heartbeats-lost", "one or two heartbeats of the autopilot are lost, everything else arrives",
        "flown on, counted",
        (
            f"{_HERE}autopilot.py::test_forty_heartbeats_are_lost_one_at_a_time_and_no_flight_ends",
            f"{_LINK}::test_one_lost_heartbeat_loses_no_link_and_is_counted",
            f"{_CONTRACT}[px4]",
        ),
        within_s=2.5,
    ),
    Fault(
        62, "failsafe-then-resume", "the autopilot's own failsafe has acted, and flockd is asked to resume",
        "not ready while nothing is offered; says what the pilot has to select",
        (
            f"{_HERE}autopilot.py::test_after_the_autopilots_failsafe_it_says_what_to_select_and_is_not_ready_before",
            f"{_CONTRACT}[px4]",
        ),
        within_s=2.0,
    ),
    Fault(
        63, "others-interfere", "a second sender of setpoints, a parameter changed in flight",
        "an event with what was seen, then Hold",
        (
            f"{_HERE}autopilot.py::test_setpoints_of_another_program_are_told_and_end_in_hold",
            f"{_HERE}autopilot.py::test_a_parameter_of_the_failsafe_that_is_changed_in_flight_is_told_and_ends_in_hold",
            f"{_CONTRACT}[px4]",
        ),
        within_s=2.0,
    ),
    Fault(
        64, "silent-autopilot",
        "an autopilot that sends texts to ground stations only, refuses without a word, restarts, or loses events",
        "the reason is in status and log, or `without a reason`",
        (
            f"{_HERE}autopilot.py::test_an_autopilot_that_refuses_without_a_word_is_told_as_such",
            f"{_LINK}::test_a_refusal_without_a_word_is_told_as_such",
            f"{_LINK}::test_an_autopilot_that_acts_on_the_loss_of_its_ground_station_hears_none_and_sends_no_texts",
            f"{_LINK}::test_events_that_are_lost_are_requested_and_come",
            f"{_LINK}::test_an_autopilot_that_has_started_anew_is_asked_for_its_streams_again",
            f"{_CONTRACT}[px4]",
        ),
        within_s=2.0,
    ),
    Fault(
        65, "landed-after-an-order", "landed and disarmed after an operator's land or hold",
        "ready for the next flight",
        (
            f"{_HERE}autopilot.py::test_landed_and_disarmed_after_an_operators_order_the_next_flight_may_begin",
        ),
        within_s=2.0,
    ),
    Fault(
        66, "own-stall", "the daemon's own stall, then Hold", "status says the cause first",
        (
            f"{_HERE}autopilot.py::test_after_the_autopilots_failsafe_it_says_what_to_select_and_is_not_ready_before",
            "tests/onboard/autopilot/test_streamer.py::"
            "test_a_stall_stays_the_cause_though_the_autopilot_has_left_offboard_meanwhile",
        ),
        within_s=2.0,
    ),
    Fault(
        67, "camera-elsewhere", "a camera is upside down or on its side, or two are swapped",
        "warned; flown without it, degraded; two: Hold",
        (
            f"{_HERE}rig.py::test_a_camera_is_upside_down_or_two_are_swapped",
            "tests/flight/geometry/test_rig_calibration.py::test_a_camera_that_is_upside_down_or_another_one_is_said",
        ),
        within_s=20.0,
    ),
    Fault(
        68, "frame-jumps", "the autopilot's local frame jumps (height, level, heading)",
        "said; home, fence, height target and goals move with it; above 1 m, or of the heading, Hold",
        (
            f"{_HERE}autopilot.py::test_a_small_jump_of_the_local_frame_is_said_and_flown_through",
            f"{_HERE}autopilot.py::test_a_large_jump_of_the_local_frame_or_the_heading_ends_in_hold",
            "tests/onboard/autopilot/test_local_frame.py",
        ),
        within_s=2.0,
    ),
    Fault(
        70, "setpoints-clipped", "the autopilot clips setpoints (`MPC_XY_VEL_MAX`)",
        "said; flown slower to the end; no other program is accused",
        (
            f"{_HERE}autopilot.py::test_where_the_autopilot_limits_setpoints_flockd_asks_for_no_more_and_nobody_is_accused",
            "tests/onboard/autopilot/test_setpoint_watch.py",
        ),
        within_s=4.0,
    ),
    Fault(
        72, "climb-interrupted", "the pilot or a failsafe changes the mode before flockd flies, while it climbs too",
        "flockd never asks for offboard, nor for any other mode",
        (
            f"{_HERE}autopilot.py::test_the_pilot_changes_the_mode_while_it_climbs_and_by_hand_and_it_asks_for_nothing",
        ),
    ),
    Fault(
        73, "landed-after-a-restart", "started again in the air, then landed by the pilot",
        "flockd never arms, and asks for nothing",
        (
            f"{_HERE}autopilot.py::test_started_in_the_air_and_landed_by_the_pilot_it_asks_for_nothing",
        ),
    ),
    Fault(
        75, "mate-stops", "a mate hovers, lands or is taken over, at any place of the formation",
        "every neighbour may brake: 1 m is kept at every instant",
        (
            "tests/sim/flock/test_mates.py::test_whichever_of_five_stops_its_mates_keep_a_metre_apart",
            "tests/flight/safety/test_surroundings.py::test_one_that_goes_may_have_braked_since_it_was_seen_last",
        ),
    ),
    Fault(
        77, "serial-port", "a serial port is replugged or wanted by two, or two autopilots are on one link",
        "on the ground it comes back, or exit code 69; in flight the link is lost; a second owner is refused with 69, "
        "two autopilots without `system_id` with 78",
        (
            f"{_HERE}serial.py::test_on_the_ground_it_comes_back_or_the_daemon_ends_for_a_restart",
            f"{_HERE}serial.py::test_in_flight_it_is_opened_again_however_long_that_takes_and_nothing_is_sent",
            f"{_HERE}serial.py::test_with_two_autopilots_and_no_system_id_it_does_not_start",
            f"{_SERIAL}::test_at_rest_it_costs_under_three_hundredths_of_a_core",
            f"{_SERIAL}::test_it_comes_back_with_the_device_which_has_forgotten_its_streams",
            f"{_SERIAL}::test_no_other_program_can_open_it_whoever_starts_it",
            "tests/onboard/autopilot/test_two_autopilots.py::"
            "test_a_second_one_that_comes_later_is_told_and_ends_it",
            "tests/onboard/autopilot/test_link_owner.py::test_a_second_owner_is_refused_until_the_first_was_killed",
            "tests/ground/doctor/test_examination.py::test_beside_a_flying_daemon_nothing_of_the_drone_is_touched",
        ),
        within_s=3.0,
    ),
    Fault(
        78, "messages-of-any-size", "messages of any size, number and source from anyone on the network",
        "dropped before they are in memory; under 10 MB, flown on",
        (
            f"{_HERE}outside.py::test_queries_of_any_size_and_number",
            "tests/onboard/telemetry/test_hostile_peer.py",
        ),
    ),
)
# fmt: on
