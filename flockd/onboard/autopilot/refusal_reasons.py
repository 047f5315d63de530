"""Why an autopilot refuses to arm or to fly offboard: the one table of reasons, each with what to do.

Reasons of PX4's own checks have the names of PX4's events; those that flockd tells from other messages have names of
their own. PX4 sends an event's number, which follows from its name.
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
UNHEALTHY = "unhealthy"
UNKNOWN_CHECK = "unknown_check"
SAID = "said"
NOT_TOLD = "not_told"
OF_STATE: Mapping[int, str] = {1: "boots", 2: "calibrates", 7: "powers_off", 8: "terminated"}
"""By the heartbeat's MAV_STATE."""


class Reason(NamedTuple):
    """One row of the table."""

    what: str
    """Is the matter."""
    remedy: str
    """What to do."""


_TABLE: Mapping[str, Mapping[str, str]] = {
    # What flockd and the pilot do.
    "check that flockd's messages reach it: the cable's other direction, its baud rate, and `autopilot.system_id`": {
        NO_SETPOINTS: "it receives no setpoints although flockd sends them",
    },
    "fly in Hold or Position until flockd's state is ready, then switch to offboard": {
        NOT_STREAMING: "it receives no setpoints, as flockd sends none yet",
    },
    "end one of the programs, or take it off the autopilot's links": {
        SEVERAL_SENDERS: "another onboard computer is on its link, and both may send setpoints",
    },
    "select another mode first, as Hold or Position": {
        "check_modes_cannot_takeoff": "it cannot be armed in its flight mode",
    },
    "switch the remote control on and calibrate it, or select a mode that needs no sticks, as Hold": {
        "check_modes_manual_control": "its flight mode needs sticks, and no remote control or joystick is heard",
    },
    "move the stick down": {"commander_arm_denied_throttle_unsafe": "the throttle is not at its lowest"},
    "turn the switch on the remote control back": {
        "check_man_control_rtl_engaged": "the return switch is on",
        "check_man_control_kill_engaged": "the kill switch is on",
        "check_man_control_landing_gear_up": "the landing gear's switch is up",
        "commander_kill_sw_engaged": "the kill switch was used",
    },
    "calibrate the remote control in the ground station": {
        "check_rc_trim_too_high": "a channel of the remote control has its middle above its end",
        "check_rc_trim_too_small": "a channel of the remote control has its middle below its end",
        "check_rc_min_too_small": "a channel of the remote control has a lower end that cannot be",
        "check_rc_max_too_high": "a channel of the remote control has an upper end that cannot be",
    },
    "connect a ground station, or set NAV_DLL_ACT to 0 if it shall fly without one": {
        "check_rc_dl_no_dllink": "no ground station is connected, and its parameters ask for one",
    },
    "press the safety button until its light stays on": {
        "check_system_safety_button": "its safety button was not pressed",
    },
    "unplug USB and start it again from the battery": {"check_system_usb_connected": "it is connected by USB"},
    "set COM_ARMABLE to 1 when all is mounted": {
        "check_armable_configuration": "its parameter COM_ARMABLE forbids to arm",
    },
    "wait until the calibration is over, or cancel it": {
        "commander_arm_denied_calibrating": "a calibration is under way",
        "calibrates": "a calibration is under way",
    },
    "wait until it has started": {"boots": "it still starts"},
    "start it again": {
        "powers_off": "it shuts down",
        "terminated": "it has terminated a flight",
        "check_system_flight_term_active": "it has terminated a flight",
    },
    "let whoever authorises flights accept it, or set COM_ARM_AUTH_REQ to 0": {
        "check_system_arm_auth_failed": "nobody authorised the flight",
    },
    # Estimates, home, satellites.
    "keep it still and level for half a minute; if it lasts, calibrate its sensors and look for vibrations": {
        "check_estimator_missing_data": "its estimator has not started",
        "check_estimator_hgt_not_stable": "its estimate of the height is not stable",
        "check_estimator_hor_pos_not_stable": "its estimate of the position is not stable",
        "check_estimator_hor_vel_not_stable": "its estimate of the horizontal velocity is not stable",
        "check_estimator_vert_vel_not_stable": "its estimate of the vertical velocity is not stable",
        "check_estimator_high_accel_bias": "its estimator finds a large bias of the accelerometer",
        "check_estimator_high_gyro_bias": "its estimator finds a large bias of the gyroscope",
        "check_modes_attitude": "it has no attitude",
        "check_modes_offboard_no_attitude": "it has no attitude, which offboard needs",
        "check_modes_angular_velocity": "it has no rate of turn",
        "check_modes_local_alt": "it has no height",
    },
    "wait for satellites under open sky, or give it another source of position": {
        "check_modes_local_pos": "it has no position that its flight mode can use",
        "check_modes_global_pos": "it has no global position that its flight mode can use",
        "check_modes_offboard_no_local_position": "it has no position, which these setpoints need",
        "check_modes_offboard_no_local_velocity": "it has no velocity, which flockd's setpoints need",
        "check_system_no_global_pos": "it has no global position",
        "check_estimator_low_position_accuracy": "its position is not accurate",
        "check_estimator_gps_fix_too_low": "its satellite receiver has no three-dimensional fix",
        "check_estimator_gps_num_sats_too_low": "its satellite receiver has too few satellites",
        "check_estimator_gps_pdop_too_high": "its satellites stand too close together",
        "check_estimator_gps_hor_pos_err_too_high": "its satellite position is uncertain horizontally",
        "check_estimator_gps_vert_pos_err_too_high": "its satellite position is uncertain vertically",
        "check_estimator_gps_speed_acc_too_low": "its satellite velocity is uncertain",
        "check_estimator_gps_hor_pos_drift_too_high": "its satellite position drifts horizontally",
        "check_estimator_gps_vert_pos_drift_too_high": "its satellite position drifts vertically",
        "check_estimator_gps_hor_speed_drift_too_high": "its satellite velocity drifts horizontally",
        "check_estimator_gps_vert_speed_drift_too_high": "its satellite velocity drifts vertically",
        "check_estimator_gps_generic": "its satellite reception is poor",
        "check_estimator_gps_not_fusing": "its estimator does not use the satellites",
        "check_gnss_receiver_no_fix": "a satellite receiver has lost its fix",
        "check_gps_position_divergence": "its satellite receivers disagree",
        "estimate_missing": "its estimator gives no attitude, height, velocity or position",
        "fix_missing": "its satellite receiver has no three-dimensional fix",
    },
    "check the receiver's cable, its power and SYS_HAS_NUM_GNSS": {
        "check_gnss_receiver_offline": "a satellite receiver is not heard",
    },
    "do not fly here, and look for transmitters near its antenna": {
        "check_estimator_gps_jamming_critical": "its satellite reception is jammed",
        "check_estimator_gps_jammed": "its satellite reception is jammed",
        "check_estimator_gps_spoofed": "its satellite signals are forged",
    },
    "wait for a position, which it sets home by if COM_HOME_EN is 1, or set home in the ground station": {
        "check_system_no_home_pos": "it has no home",
        "check_modes_home_position": "it has no home, which its flight mode needs",
        "check_gf_no_home": "it has no home, which the action of its geofence (GF_ACTION 3) needs",
        "home_missing": "it has not told its home",
    },
    "calibrate the compass away from metal and currents": {
        "check_mag_not_calibrated": "a compass is not calibrated",
        "check_mag_consistency": "its compasses disagree",
        "check_mag_fault": "its estimator rejects a compass",
        "check_estimator_mag_fault": "its estimator no longer uses the compass",
        "check_estimator_mag_interference": "the magnetic field is disturbed",
        "check_estimator_heading_not_stable": "its heading is not valid",
        "check_estimator_heading_no_source": "nothing gives its heading",
        "check_estimator_gnss_fault": "its heading from satellites is not reliable",
    },
    # Geofence and mission.
    "bring it inside, or set GF_MAX_HOR_DIST, GF_MAX_VER_DIST and the fence of the ground station as they should be": {
        "check_gf_violation_max_alt": "it is higher than its geofence allows",
        "check_gf_violation_max_hor_dist": "it is farther from home than its geofence allows",
        "check_gf_violation_custom_gf": "it is outside its geofence, or close to its border",
    },
    "upload a mission, or set COM_ARM_MIS_REQ to 0": {"check_modes_mission": "it has no mission"},
    "correct the mission and the rally points in the ground station": {
        "check_mission_failure": "its mission cannot be flown",
        "check_navigator_failure_hagl": "its mission is higher than it can measure the ground",
        "check_rally_point_missing": "no rally point is set",
    },
    # Battery and power.
    "charge or change the battery; check BAT1_V_EMPTY, BAT1_V_CHARGED and the limits BAT_LOW_THR and BAT_CRIT_THR": {
        "check_battery_low": "the battery is low",
        "check_battery_critical": "the battery is nearly empty",
        "check_battery_emergency": "the battery is empty",
        "check_battery_rem_flight_time_low": "the battery is too low for the way home",
    },
    "check the battery, its plug and its data cable": {
        "check_battery_unhealthy": "the battery reports that it is not well",
        "check_battery_fault": "the battery reports a fault",
        "check_battery_disconnected": "a battery is not connected",
        "check_battery_missing": "a battery that its parameters name is missing",
    },
    "check the power module and the wires of the supply; CBRK_SUPPLY_CHK 894281 switches the check off": {
        "check_avionics_power_missing": "no power module is connected",
        "check_avionics_power_low": "the voltage of its supply is too low",
        "check_avionics_power_high": "the voltage of its supply is too high",
        "check_avionics_power_redundancy": "fewer power supplies are connected than COM_POWER_COUNT asks for",
        "check_missing_system_power": "its own supply is not measured",
        "check_power_oc_periph": "its supply for peripherals has too much current",
        "check_power_oc_hipower": "its supply for strong peripherals has too much current",
    },
    # Sensors.
    "calibrate it in the ground station": {
        "check_gyro_not_calibrated": "a gyroscope is not calibrated",
        "check_accel_not_calibrated": "an accelerometer is not calibrated",
    },
    "keep it still, then calibrate both in the ground station": {
        "check_imu_gyro_inconsistent": "its gyroscopes disagree",
        "check_imu_accel_inconsistent": "its accelerometers disagree",
    },
    "check the sensor and its cable, or correct how many the autopilot's parameters SYS_HAS_... name": {
        "check_gyro_no_data": "a gyroscope gives no data",
        "check_gyro_missing": "a gyroscope is missing",
        "check_accel_no_data": "an accelerometer gives no data",
        "check_accel_missing": "an accelerometer is missing",
        "check_mag_no_data": "a compass gives no data",
        "check_mag_missing": "a compass is missing",
        "check_mag_sys_has_mag_missing": "fewer compasses are found than SYS_HAS_MAG asks for",
        "check_baro_no_data": "the barometer gives no data",
        "check_baro_missing": "the barometer is missing",
        "check_distance_sensor_missing": "a range finder is missing",
        "check_distance_sensor_invalid": "a range finder gives no valid data",
        "check_optical_sensor_missing": "its optical flow sensor is missing",
        "check_optical_flow_sensor_invalid": "its optical flow sensor gives no valid data",
        "check_airspeed_no_data": "its airspeed sensor gives no data",
        "check_airspeed_invalid": "its airspeed is not valid",
        "check_airspeed_too_high": "its airspeed sensor measures wind on the ground",
        UNHEALTHY: "a sensor or system of it is not healthy",
    },
    "level it, keep it still, and start it again if it lasts": {
        "check_failure_detector_roll": "it leans to the side more than its failure detector allows",
        "check_failure_detector_pitch": "it leans forward or back more than its failure detector allows",
        "check_failure_detector_alt": "it has lost height in a failure",
    },
    "switch the external failure signal off, or set FD_EXT_ATS_EN to 0": {
        "check_failure_detector_ext": "an external system reports a failure",
    },
    # Motors.
    "check propellers, motors and their controllers": {
        "check_failure_detector_arm_esc": "a motor controller reports a failure",
        "check_failure_detector_imbalanced_prop": "a propeller is out of balance",
        "check_motor_overcurrent": "a motor takes too much current",
        "check_motor_undercurrent": "a motor takes too little current",
        "check_escs_offline": "a motor controller is not heard",
        "check_escs_telem_missing": "the motor controllers send no telemetry",
        "check_escs_not_all_armed": "not all motor controllers are armed",
        "check_esc_over_temperature": "a motor controller is too hot",
    },
    # The autopilot's computer, and further systems.
    "take load off it: fewer streams, a lower log rate, no programs that are not needed": {
        "check_cpuload_too_high": "its processor is busier than COM_CPU_MAX allows",
        "check_ram_usage_too_high": "its memory is fuller than COM_RAM_MAX allows",
        "check_missing_cpuload": "it does not tell its load",
    },
    "put an SD card into it, or set COM_ARM_SDCARD to 0": {"check_missing_fmu_sdcard": "its SD card is missing"},
    "read and remove the crash dumps on its SD card, and report them": {
        "check_hardfault_present": "it has crashed before",
        "check_task_watchdog_present": "one of its tasks has hung before",
    },
    "wait until it is calm, or set COM_WIND_MAX": {"check_wind_too_high": "the wind is above its limit"},
    "land, and start it again or set COM_FLT_TIME_MAX": {"check_flight_time_limit": "its flight time is over"},
    "connect the system, or clear the parameter that asks for it (COM_PARACHUTE, COM_ARM_ODID, COM_ARM_TRAFF)": {
        "check_parachute_missing": "its parachute is missing",
        "check_parachute_unhealthy": "its parachute is not ready",
        "check_open_drone_id_missing": "its remote identification is missing",
        "check_open_drone_id_unhealthy": "its remote identification is not ready",
        "check_traffic_avoidance_missing": "its system against other traffic is missing",
    },
    "start the program that flies this mode, or select another mode": {
        "check_external_modes_unavailable": "the program of its flight mode is not there",
        "check_external_modes_unresponsive": "the program of its flight mode does not respond",
    },
    "cool the onboard computer": {
        "check_companion_computer_temperature_high": "it hears that the onboard computer is too hot",
    },
    "flockd flies multicopters: switch it to that mode": {
        "check_system_vtol_in_transition": "it is between hover and forward flight",
        "check_system_vtol_in_fw_mode": "it is not in its multicopter mode",
        "check_vtol_fixed_wing_system_failure": "its forward flight has failed",
    },
    # What has no name here.
    "read its checks in a ground station, or the messages before this one": {
        CHECKS_FAIL: "its checks before the flight fail",
        UNKNOWN_CHECK: "a check fails that flockd has no words for",
        SAID: "it says why",
        NOT_TOLD: "it gives no reason",
    },
}

REASONS: Mapping[str, Reason] = {
    name: Reason(what, remedy) for remedy, reasons in _TABLE.items() for name, what in reasons.items()
}
"""By name, and in the order in which several are told: the one that others follow from first."""

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
"""By MAV_RESULT, where the autopilot says nothing else."""

SYSTEMS: Mapping[int, str] = {
    1 << 0: "the gyroscope",
    1 << 1: "the accelerometer",
    1 << 2: "the compass",
    1 << 3: "the barometer",
    1 << 5: "the satellite receiver",
    1 << 6: "optical flow",
    1 << 8: "the range finder",
    1 << 15: "the motor outputs",
    1 << 16: "the remote control",
    1 << 20: "the geofence",
    1 << 21: "the attitude estimator",
    1 << 24: "logging",
    1 << 25: "the battery",
}
"""By the bits of MAV_SYS_STATUS_SENSOR."""

TEXTS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("no offboard signal",), NO_SETPOINTS),
    (("gyro", "uncalibrated"), "check_gyro_not_calibrated"),
    (("accel", "uncalibrated"), "check_accel_not_calibrated"),
    (("compass", "uncalibrated"), "check_mag_not_calibrated"),
    (("safety button",), "check_system_safety_button"),
    (("kill switch",), "check_man_control_kill_engaged"),
    (("throttle",), "commander_arm_denied_throttle_unsafe"),
    (("calibrating",), "commander_arm_denied_calibrating"),
    (("home position",), "check_system_no_home_pos"),
    (("global position",), "check_system_no_global_pos"),
    (("position", "estimate"), "check_modes_local_pos"),
    (("horizontal position",), "check_estimator_hor_pos_not_stable"),
    (("ekf2 missing",), "check_estimator_missing_data"),
    (("heading",), "check_estimator_heading_not_stable"),
    (("manual control",), "check_modes_manual_control"),
    (("connection", "gcs"), "check_rc_dl_no_dllink"),
    (("geofence",), "check_gf_violation_custom_gf"),
    (("low battery",), "check_battery_low"),
    (("critical battery",), "check_battery_critical"),
    (("power module",), "check_avionics_power_missing"),
    (("usb",), "check_system_usb_connected"),
)
"""Words of a STATUSTEXT, in lower case, by which a firmware without events tells a reason; the first row counts."""

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
    """The number by which PX4 sends an event of its autopilot component: 24 bits of FNV-1a, and the component."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = ((value ^ byte) * 0x01000193) & 0xFFFFFFFF
    return 1 << 24 | value & 0xFFFFFF


NAMES: Mapping[int, str] = {event_number(name): name for name in REASONS}
"""By the event's number."""
