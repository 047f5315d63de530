"""The table of reasons why an autopilot refuses to arm or to fly offboard, each with its remedy.

Reasons of PX4's checks have the names of PX4's events; those that flockd derives from other messages have their own
names. PX4 sends an event's number, which follows from its name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from flockd.onboard.autopilot.autopilot_status import FlightMode

NO_SETPOINTS = "check_modes_offboard_signal_lost"
CHECKS_FAIL = "commander_arm_denied_resolve_failures"
"""PX4's names; what follows are flockd's own."""
NOT_STREAMING = "no_setpoints_sent"
SEVERAL_SENDERS = "several_senders"
UNKNOWN_CHECK = "unknown_check"
OF_STATE: Mapping[int, str] = {1: "boots", 2: "calibrates", 7: "powers_off", 8: "terminated"}
"""Reasons by the heartbeat's MAV_STATE."""


class Reason(NamedTuple):
    """One row of the table."""

    what: str
    """The reason, for people."""
    remedy: str
    """What to do."""


_TABLE = """\
check that flockd's messages reach it: the cable's other direction, its baud rate, and `autopilot.system_id`
  check_modes_offboard_signal_lost: it receives no setpoints although flockd sends them
fly in Hold or Position until flockd's state is ready, then switch to offboard
  no_setpoints_sent: it receives no setpoints, as flockd sends none yet
end one of the programs, or take it off the autopilot's links
  several_senders: another onboard computer is on its link, and both may send setpoints
select another mode first, as Hold or Position
  check_modes_cannot_takeoff: it cannot be armed in its flight mode
switch the remote control on and calibrate it, or select a mode that needs no sticks, as Hold
  check_modes_manual_control: its flight mode needs sticks, and no remote control or joystick is heard
move the stick down
  commander_arm_denied_throttle_unsafe: the throttle is not at its lowest
turn the switch on the remote control back
  check_man_control_kill_engaged: the kill switch is on
  check_man_control_rtl_engaged check_man_control_landing_gear_up commander_kill_sw_engaged
calibrate the remote control in the ground station
  check_rc_trim_too_high check_rc_trim_too_small check_rc_min_too_small check_rc_max_too_high
connect a ground station, or set NAV_DLL_ACT to 0 if it shall fly without one
  check_rc_dl_no_dllink: no ground station is connected, and its parameters ask for one
press the safety button until its light stays on
  check_system_safety_button: its safety button was not pressed
unplug USB and start it again from the battery
  check_system_usb_connected: it is connected by USB
set COM_ARMABLE to 1 when all is mounted
  check_armable_configuration: its parameter COM_ARMABLE forbids to arm
wait until the calibration is over, or cancel it
  commander_arm_denied_calibrating: a calibration is under way
  calibrates: a calibration is under way
wait until it has started
  boots: it still starts
start it again
  powers_off: it shuts down
  terminated: it has terminated a flight
  check_system_flight_term_active
let whoever authorises flights accept it, or set COM_ARM_AUTH_REQ to 0
  check_system_arm_auth_failed
keep it still and level for half a minute; if it lasts, calibrate its sensors and look for vibrations
  check_estimator_missing_data: its estimator has not started
  check_estimator_hgt_not_stable check_estimator_hor_pos_not_stable check_estimator_hor_vel_not_stable
  check_estimator_vert_vel_not_stable check_estimator_high_accel_bias check_estimator_high_gyro_bias
  check_modes_attitude check_modes_offboard_no_attitude check_modes_angular_velocity check_modes_local_alt
wait for satellites under open sky, or give it another source of position
  check_modes_local_pos: it has no position that its flight mode can use
  check_modes_global_pos: it has no global position that its flight mode can use
  check_modes_offboard_no_local_position: it has no position, which these setpoints need
  check_modes_offboard_no_local_velocity: it has no velocity, which flockd's setpoints need
  check_system_no_global_pos: it has no global position
  check_estimator_low_position_accuracy check_estimator_gps_fix_too_low check_estimator_gps_num_sats_too_low
  check_estimator_gps_pdop_too_high check_estimator_gps_hor_pos_err_too_high check_estimator_gps_vert_pos_err_too_high
  check_estimator_gps_speed_acc_too_low check_estimator_gps_hor_pos_drift_too_high
  check_estimator_gps_vert_pos_drift_too_high check_estimator_gps_hor_speed_drift_too_high
  check_estimator_gps_vert_speed_drift_too_high check_estimator_gps_generic check_estimator_gps_not_fusing
  check_gnss_receiver_no_fix check_gps_position_divergence
check the receiver's cable, its power and SYS_HAS_NUM_GNSS
  check_gnss_receiver_offline
do not fly here, and look for transmitters near its antenna
  check_estimator_gps_jamming_critical check_estimator_gps_jammed check_estimator_gps_spoofed
wait for a position, which it sets home by if COM_HOME_EN is 1, or set home in the ground station
  check_system_no_home_pos: it has no home
  check_modes_home_position: it has no home, which its flight mode needs
  check_gf_no_home: it has no home, which the action of its geofence (GF_ACTION 3) needs
calibrate the compass away from metal and currents
  check_mag_not_calibrated: a compass is not calibrated
  check_mag_consistency check_mag_fault check_estimator_mag_fault check_estimator_mag_interference
  check_estimator_heading_not_stable check_estimator_heading_no_source check_estimator_gnss_fault
bring it inside, or set GF_MAX_HOR_DIST, GF_MAX_VER_DIST and the fence of the ground station as they should be
  check_gf_violation_max_alt: it is higher than its geofence allows
  check_gf_violation_max_hor_dist: it is farther from home than its geofence allows
  check_gf_violation_custom_gf: it is outside its geofence, or close to its border
upload a mission, or set COM_ARM_MIS_REQ to 0
  check_modes_mission: it has no mission
correct the mission and the rally points in the ground station
  check_mission_failure check_navigator_failure_hagl check_rally_point_missing
charge or change the battery; check BAT1_V_EMPTY, BAT1_V_CHARGED and the limits BAT_LOW_THR and BAT_CRIT_THR
  check_battery_low: the battery is low
  check_battery_critical: the battery is nearly empty
  check_battery_emergency: the battery is empty
  check_battery_rem_flight_time_low
check the battery, its plug and its data cable
  check_battery_unhealthy check_battery_fault check_battery_disconnected check_battery_missing
check the power module and the wires of the supply; CBRK_SUPPLY_CHK 894281 switches the check off
  check_avionics_power_missing check_avionics_power_low check_avionics_power_high check_avionics_power_redundancy
  check_missing_system_power check_power_oc_periph check_power_oc_hipower
calibrate it in the ground station
  check_gyro_not_calibrated: a gyroscope is not calibrated
  check_accel_not_calibrated: an accelerometer is not calibrated
keep it still, then calibrate both in the ground station
  check_imu_gyro_inconsistent check_imu_accel_inconsistent
check the sensor and its cable, or correct how many the autopilot's parameters SYS_HAS_... name
  check_mag_sys_has_mag_missing: fewer compasses are found than SYS_HAS_MAG asks for
  check_distance_sensor_missing: a range finder is missing
  check_optical_sensor_missing: its optical flow sensor is missing
  check_gyro_no_data check_gyro_missing check_accel_no_data check_accel_missing check_mag_no_data check_mag_missing
  check_baro_no_data check_baro_missing check_distance_sensor_invalid check_optical_flow_sensor_invalid
  check_airspeed_no_data check_airspeed_invalid check_airspeed_too_high
level it, keep it still, and start it again if it lasts
  check_failure_detector_roll check_failure_detector_pitch check_failure_detector_alt
switch the external failure signal off, or set FD_EXT_ATS_EN to 0
  check_failure_detector_ext
check propellers, motors and their controllers
  check_failure_detector_arm_esc check_failure_detector_imbalanced_prop check_motor_overcurrent
  check_motor_undercurrent check_escs_offline check_escs_telem_missing check_escs_not_all_armed
  check_esc_over_temperature
take load off it: fewer streams, a lower log rate, no programs that are not needed
  check_cpuload_too_high: its processor is busier than COM_CPU_MAX allows
  check_ram_usage_too_high check_missing_cpuload
put an SD card into it, or set COM_ARM_SDCARD to 0
  check_missing_fmu_sdcard
read and remove the crash dumps on its SD card, and report them
  check_hardfault_present check_task_watchdog_present
wait until it is calm, or set COM_WIND_MAX
  check_wind_too_high
land, and start it again or set COM_FLT_TIME_MAX
  check_flight_time_limit
connect the system, or clear the parameter that asks for it (COM_PARACHUTE, COM_ARM_ODID, COM_ARM_TRAFF)
  check_parachute_missing: its parachute is missing
  check_open_drone_id_missing: its remote identification is missing
  check_traffic_avoidance_missing: its system against other traffic is missing
  check_parachute_unhealthy check_open_drone_id_unhealthy
start the program that flies this mode, or select another mode
  check_external_modes_unavailable check_external_modes_unresponsive
cool the onboard computer
  check_companion_computer_temperature_high
flockd flies multicopters: switch it to that mode
  check_system_vtol_in_transition check_system_vtol_in_fw_mode check_vtol_fixed_wing_system_failure
read its checks in a ground station, or the messages before this one
  commander_arm_denied_resolve_failures: its checks before the flight fail
  unknown_check: a check fails that flockd has no words for
"""
"""Each remedy, followed by the reasons that it mends: name and words. PX4's names without words explain themselves."""


def _reasons() -> dict[str, Reason]:
    found, remedy = dict[str, Reason](), ""
    for line in _TABLE.splitlines():
        name, told, what = line.strip().partition(": ")
        if not line.startswith(" "):
            remedy = line
        elif told:
            found[name] = Reason(what, remedy)
        else:
            found |= {
                one: Reason(f"its check `{one.partition('_')[2].replace('_', ' ')}` fails", remedy)
                for one in line.split()
            }
    return found


REASONS: Mapping[str, Reason] = _reasons()
"""By name, in the order in which several are reported: causes before consequences."""

RANK: Mapping[str, int] = {name: place for place, name in enumerate(REASONS)}

REMEDIES_OF_RESULTS: Mapping[int, str] = {
    1: "wait a few seconds and ask again",
    2: "check the reasons that `flockd status` shows",
    3: "update the firmware",
    4: "check the reasons that `flockd status` shows",
    5: "wait until it is done",
    6: "ask again",
    10: "release the control in the ground station that has it",
}
"""By MAV_RESULT, if the autopilot gives no other reason."""

NAVIGATION_STATES: Mapping[FlightMode, int] = {
    "manual": 0,
    "stabilized": 15,
    "acro": 10,
    "altitude": 1,
    "position": 2,
    "mission": 3,
    "hold": 4,
    "return": 5,
    "offboard": 14,
    "take-off": 17,
    "land": 18,
}
"""Each mode's bit in PX4's reports."""


def event_number(name: str) -> int:
    """The number of an event of PX4's autopilot component: 24 bits of FNV-1a, and the component."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = ((value ^ byte) * 0x01000193) & 0xFFFFFFFF
    return 1 << 24 | value & 0xFFFFFF


NAMES: Mapping[int, str] = {event_number(name): name for name in REASONS}
"""By the event's number."""
