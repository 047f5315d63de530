"""The autopilot's own log beside a flight: read, laid on the flight's time, drawn; and files that are none."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.errors import UsageError
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.autopilot_log import AutopilotLog
from flockd.review.flight_log.from_recordings import autopilot_clock
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import FlightMetadata, MissionMetadata
from flockd.review.flight_log.ulog import autopilot_log, drone_of, read_ulog
from flockd.review.report.autopilot_figure import autopilot_texts
from flockd.review.report.flight_folder import save_flight
from tests.onboard.recording.made_up import MadeUpPilot, drone_config, inputs
from tests.review.flight_log.made_ulog import HEADER, Rows, _message, write_ulog

BOOT_S = 900.0
"""The autopilot's clock at the flight's start."""
CLOCK_AT_START_S = 47_000.0
"""The computer's."""
STEP_S, STEPS = 0.5, 60
LITTLE_BYTES = 3 << 29
"""Less than a reader of ULog takes where it may."""


def _commanded(time_s: float) -> tuple[float, float]:
    """(2,) m/s: turns by a quarter at 12 s, faster at 20 s; held from each step to the next."""
    step_s = STEP_S * int(time_s / STEP_S)
    return (1.0, 0.0) if step_s < 12.0 else (0.0, 1.0 if step_s < 20.0 else 2.0)


def _log() -> FlightLog:
    times_s = np.asarray(STEP_S * np.arange(STEPS), np.float64)
    metadata = FlightMetadata(
        mission=MissionMetadata(kind="hover", reached_m=1.0),
        scenario="kestrel", perception="learned", flow="dis", scale="height", drones=1, duration_s=30.0, step_s=STEP_S,
        circle_until_s=0.0, desired_distance_m=3.5, observation_distance_m=10.0, separation_distance_m=2.0,
        names=["kestrel"], recorded=["kestrel"], clock_at_start_s=CLOCK_AT_START_S,
    )  # fmt: skip
    nothing = np.full((STEPS, 1, 3), np.nan)
    pairs = np.full((STEPS, 1, 1, 3), np.nan)
    command = np.array([_commanded(time_s) for time_s in times_s])[:, None]
    return FlightLog(
        time_s=times_s, position=nothing, velocity=nothing, attitude=np.full((STEPS, 1, 3, 3), np.nan),
        desired=np.zeros((STEPS, 2)), command_velocity=command, command_acceleration=np.zeros((STEPS, 1, 2)),
        ego_rotation=np.full((STEPS, 1, 3, 3), np.nan), ego_translation=nothing,
        ego_inlier_ratio=np.full((STEPS, 1), np.nan), own_velocity_estimate=nothing, neighbour_position=pairs,
        neighbour_velocity=pairs, detection_position=pairs, false_tracks=np.zeros((STEPS, 1), int),
        truth_position=np.zeros((0, 1, 3)), truth_velocity=np.zeros((0, 1, 3)), stages_ms={}, metadata=metadata,
    )  # fmt: skip


def _ulog(path: Path, *, boot_s: float = BOOT_S, system_id: int = 1, without: str = "") -> Path:
    """Setpoints at 20 Hz as commanded, what was flown 0.3 s later, offboard from 1 s to 25 s, then a failsafe."""
    asked = [(boot_s + 0.05 * i, ((*_commanded(0.05 * i), np.nan), (np.nan, np.nan, -4.0))) for i in range(20, 500)]
    flown = [(boot_s + 0.1 * i, (*_commanded(max(0.1 * i - 0.3, 0.0)), -4.0)) for i in range(300)]
    states = [(boot_s + t, (14 if 1.0 <= t < 25.0 else 4, t >= 25.0)) for t in np.arange(0.0, 29.0, 0.5)]
    topics: dict[str, tuple[list[tuple[str, str]], Rows]] = {
        "trajectory_setpoint": ([("float[3]", "velocity"), ("float[3]", "position")], asked),
        "vehicle_local_position": ([("float", "vx"), ("float", "vy"), ("float", "z")], flown),
        "vehicle_status": ([("uint8_t", "nav_state"), ("bool", "failsafe")], states),
        "home_position": ([("float", "z")], [(boot_s, (0.5,))]),
    }
    topics.pop(without, None)
    messages = [(boot_s + 25.0, 2, "Failsafe activated"), (boot_s + 3.0, 6, "not worth telling")]
    return write_ulog(path, topics, messages=messages, system_id=system_id)


def _clock(offset_s: float = BOOT_S - CLOCK_AT_START_S) -> tuple[np.ndarray, np.ndarray]:
    times_s = CLOCK_AT_START_S + np.arange(0.0, 30.0)
    return times_s, np.full(30, offset_s)


def test_by_the_recorded_clock_everything_is_where_it_happened(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg")
    beside = autopilot_log(read_ulog(path), path, _log(), 0, _clock())
    assert beside.placed_by.startswith("the autopilot's clock")
    assert [span.what for span in beside.modes] == ["hold", "offboard", "hold"]
    assert [span.begin_s for span in beside.modes] == pytest.approx([0.0, 1.0, 25.0], abs=1e-3)
    assert [span.end_s for span in beside.modes] == pytest.approx([1.0, 25.0, 28.5], abs=1e-3)
    (failsafe,) = beside.failsafes
    assert (failsafe.begin_s, failsafe.end_s) == pytest.approx((25.0, 28.5), abs=1e-3)
    (said,) = beside.said
    assert said.time_s == pytest.approx(25.0, abs=1e-3)
    assert said.text == "Failsafe activated"
    turned_s = beside.setpoint_time_s[np.argmax(beside.setpoint_velocity[:, 1] > 0.5)]
    assert turned_s == pytest.approx(12.0, abs=0.05)
    assert beside.setpoint_height_m[0] == pytest.approx(4.5), "above home, which is half a metre below the origin"
    assert beside.flown_height_m[0] == pytest.approx(4.5)


def test_without_a_recorded_clock_the_commands_tell_the_time(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg")
    beside = autopilot_log(read_ulog(path), path, _log(), 0, None)
    assert beside.placed_by.startswith("its setpoints")
    assert beside.modes[1].begin_s == pytest.approx(1.0, abs=0.1)
    assert beside.modes[1].end_s == pytest.approx(25.0, abs=0.1)


def test_the_autopilots_clock_comes_from_the_recording(tmp_path: Path) -> None:
    config = drone_config()
    with Recorder(tmp_path / "drone1.mcap", drone="drone1", config=config) as recorder:
        for frames, vehicle in inputs(2):
            recorder.step(frames, vehicle, MadeUpPilot(config).step(frames, vehicle))
        for time_s, offset_s in ((100.0, None), (101.0, -46_100.25), (102.0, -46_100.26)):
            others = {"error_s": None, "jitter_s": None, "round_trip_s": None, "age_s": None}
            recorder.publish("drone1", "clock", {"time_s": time_s, "offset_s": offset_s, **others})
    clock = autopilot_clock(Recording(tmp_path / "drone1.mcap"))
    assert clock is not None
    assert (clock[0].tolist(), clock[1].tolist()) == ([101.0, 102.0], [-46_100.25, -46_100.26])


def test_what_was_saved_is_read_again(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg")
    beside = autopilot_log(read_ulog(path), path, _log(), 0, _clock())
    beside.save(tmp_path / "autopilot.npz")
    again = AutopilotLog.load(tmp_path / "autopilot.npz")
    assert (again.modes, again.failsafes, again.said) == (beside.modes, beside.failsafes, beside.said)
    np.testing.assert_array_equal(again.setpoint_velocity, beside.setpoint_velocity)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "does not begin as one"),
        (b"\x89MCAP0\r\n" * 9, "does not begin as one"),
        (HEADER, "cannot be read"),
        (HEADER + bytes(8) + b"\xff\xff\xff\xff" * 20, "cannot be read"),
    ],
)
def test_a_file_that_is_no_ulog_is_refused_in_one_sentence(data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(data)
    with pytest.raises(UsageError) as refused:
        read_ulog(path)
    text = str(refused.value)
    assert text.startswith(f"{path}: ")
    assert words in text
    assert "name a ULog file of this flight" in text
    assert "\n" not in text


def test_a_changed_byte_that_keeps_its_reader_busy_for_ever_is_one_sentence(tmp_path: Path) -> None:
    """The length of the last definition: pyulog goes back by so many bytes, to before what it has read."""
    path = tmp_path / "log.ulg"
    definitions = _message("I", bytes([11]) + b"char[200] k" + b"x" * 200) * 400
    path.write_bytes(HEADER + bytes(8) + _message("B", bytes(40)) + definitions + b"\xff\xffX" + bytes(100))
    with pytest.raises(
        UsageError, match=r"log\.ulg: cannot be read within \d+ s, or its memory: it is damaged; name a ULog file"
    ):
        read_ulog(path, patience_s=3.0)


def test_a_process_that_has_little_memory_already_reads_a_log_within_that(tmp_path: Path) -> None:
    """A limit cannot be raised: to ask for more than one has was an error that nobody expected."""
    path = _ulog(tmp_path / "log.ulg")
    code = "import sys; from pathlib import Path; from flockd.review.flight_log.ulog import read_ulog; "
    ended = subprocess.run(
        [sys.executable, "-c", f"{code}print(len(read_ulog(Path(sys.argv[1])).topics))", str(path)],
        capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LITTLE_BYTES, LITTLE_BYTES)),
    )  # fmt: skip
    assert (ended.returncode, ended.stdout) == (0, "4\n"), ended.stderr


def test_a_pipe_is_refused_without_waiting_for_its_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.ulg")
    with pytest.raises(UsageError, match=r"log\.ulg: is not an ordinary file"):
        read_ulog(tmp_path / "log.ulg")


def test_a_log_that_ends_in_the_middle_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg")
    path.write_bytes(path.read_bytes()[:-700])
    beside = autopilot_log(read_ulog(path), path, _log(), 0, _clock())
    assert beside.setpoint_time_s[-1] > 20.0


def test_logs_that_cannot_be_of_the_flight_are_refused(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg", without="vehicle_status")
    with pytest.raises(UsageError, match=r"holds no vehicle_status\.timestamp; name a ULog"):
        read_ulog(path)
    path = _ulog(tmp_path / "log.ulg", boot_s=5000.0)
    with pytest.raises(UsageError, match="is of another flight: it covers 4100 to 4130 s of this one's time"):
        autopilot_log(read_ulog(path), path, _log(), 0, _clock())
    path = _ulog(tmp_path / "log.ulg", system_id=7)
    with pytest.raises(UsageError, match="is of the autopilot with MAV_SYS_ID 7, which no drone of this flight has"):
        drone_of(read_ulog(path), path, _two_drones(), [])
    still = _log()
    still.command_velocity[:] = 0.0
    with pytest.raises(UsageError, match="holds no clock of the autopilot and too little was commanded to tell by"):
        autopilot_log(read_ulog(path), path, still, 0, None)
    other = _log()
    other.command_velocity[20:40] = 5.0
    with pytest.raises(UsageError, match="its setpoints are not those of the flight"):
        autopilot_log(read_ulog(path), path, other, 0, None)


def test_times_that_a_damaged_log_claims_take_no_memory(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg")
    ulog = read_ulog(path)
    setpoints = {name: np.array(values) for name, values in ulog.topics["trajectory_setpoint"].items()}
    setpoints["timestamp"][-1] = 2**64 - 1
    damaged = replace(ulog, topics={**ulog.topics, "trajectory_setpoint": setpoints})
    with pytest.raises(UsageError, match="its times are damaged: they span more than a day, or run backwards"):
        autopilot_log(damaged, path, _log(), 0, None)


def _two_drones() -> FlightLog:
    log = _log()
    twice = {
        name: np.repeat(value, 2, axis=1)
        for name, value in vars(log).items()
        if isinstance(value, np.ndarray) and value.shape[1:2] == (1,)
    }
    for name in ("neighbour_position", "neighbour_velocity", "detection_position"):
        twice[name] = np.repeat(twice[name], 2, axis=2)
    return FlightLog(**{**vars(log), **twice})


def test_the_reports_table_has_modes_failsafes_and_messages_by_time(tmp_path: Path) -> None:
    path = _ulog(tmp_path / "log.ulg")
    texts = autopilot_texts(_log(), autopilot_log(read_ulog(path), path, _log(), 0, _clock()))
    rows = [(row["begin"], row["end"], row["what"]) for row in texts["autopilot_rows"]]
    assert rows == [
        ("0.0", "1.0", "hold"),
        ("1.0", "25.0", "offboard"),
        ("25.0", "", "Failsafe activated"),
        ("25.0", "28.5", "failsafe"),
        ("25.0", "28.5", "hold"),
    ]
    assert (texts["autopilot_drone"], texts["autopilot_source"]) == ("kestrel", "log.ulg")


def test_a_bad_file_is_refused_before_anything_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "flight").mkdir()
    (tmp_path / "log.ulg").write_bytes(b"no log")
    assert main(["report", str(tmp_path / "flight"), "--ulog", str(tmp_path / "log.ulg")]) == 2
    assert "log.ulg: does not begin as one; name a ULog file" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "flight"), "--ulog", str(tmp_path / "none.ulg")]) != 0
    assert "none.ulg" in capsys.readouterr().err


@pytest.mark.slow
def test_the_report_of_a_flights_folder_shows_it_and_keeps_it(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    folder.mkdir()
    save_flight(folder, _log(), ())
    ulog = _ulog(tmp_path / "log.ulg")
    assert main(["report", str(folder), "--ulog", str(ulog)]) == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "What the autopilot logged" in page
    assert "Failsafe activated" in page
    assert "From log.ulg, laid" in page
    assert (folder / "figures" / "autopilot.png").is_file()
    ulog.unlink()
    assert main(["report", str(folder)]) == 0
    assert "What the autopilot logged" in (folder / "report.html").read_text(encoding="utf-8")
