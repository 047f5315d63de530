"""The report of recordings: two drones side by side, whose estimates are off as the test says, with truth and not."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.messages import NO_STATUS, EgoMotion, FrameSet, LearnedSize, MissionOrder, PilotOutput, VehicleState
from flockd.flight.geometry import RangeMap
from flockd.flight.perception import Observation
from flockd.flight.perception.observation import CameraObservation
from flockd.flight.pilot import StepTrace
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.mcap_file import Damage, Entry, McapFile, read_records
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.streams import OUTPUT, TRUTH
from flockd.onboard.recording.truth import TrueDrone, Truth
from flockd.review.flight_log.from_recordings import flight_log, key_frames, recordings_in
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.summary import summarise
from tests import make
from tests.onboard.recording.made_up import HEIGHT, MODELS, WIDTH, MadeUpPilot, drone_config, with_facts

NAMES = ("drone1", "drone2")
STEPS, STEP_S = 12, 0.5
APART_M = 4.0
"""drone2 is this far east of drone1; both fly north at 1 m/s, 5 m above ground."""
LONG_M = 0.02
"""Each believes to have flown this much farther in each step."""
UNKNOWN_STEPS = 3
"""For so long neither knows the other; then 1 % too far."""
COMPANION_M = 1.5
"""With exact states they would be this far apart."""

Capture = pytest.CaptureFixture[str]


def truth_at(time_s: float) -> Truth:
    return Truth(
        time_s,
        tuple(
            TrueDrone(
                name=name,
                position=np.array([time_s, APART_M * i, -5.0]),
                velocity=np.array([1.0, 0.0, 0.0]),
                R_ned_body=np.eye(3),
                exact_position=np.array([time_s, COMPANION_M * i, -5.0]),
                exact_velocity=np.array([1.0, 0.0, 0.0]),
            )
            for i, name in enumerate(NAMES)
        ),
    )


def output_of(drone: int, step: int, time_s: float) -> PilotOutput:
    east_m = 1.01 * APART_M * (1 if drone == 0 else -1)
    known = make.neighbour((0.0, east_m, 0.0), (1.0, 0.0, 0.0), track=7)
    false = replace(known, track=9, position=np.array([-20.0, 0.0, 0.0]))
    neighbours = [known] * (step >= UNKNOWN_STEPS) + [false] * (drone == 0 and step == 5)
    desired = np.exp(1j * STEP_S * step / 10.0)  # Eq. 43 with the defaults: 1 m/s around a circle of 10 m
    moved = EgoMotion(np.eye(3), np.array([STEP_S + LONG_M, 0.0, 0.0]), STEP_S, 100, 80, 0.1)
    return make.output(
        time_s,
        ego_motion=moved if step else None,
        velocity=np.array([1.04, 0.0, 0.0]) if step else None,
        detections=(make.detection((0.0, east_m, 0.0), cameras=("left",)),),
        detection_tracks=(7,),
        neighbours=tuple(neighbours),
        command=make.wanted((1.0, 0.1)),
        stages_ms={"scene": 10.0 + step},
        mission=replace(NO_STATUS, desired=np.array([desired.real, desired.imag])),
    )


def inputs_at(step: int, time_s: float) -> tuple[FrameSet, VehicleState]:
    image = np.random.default_rng(step).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)  # fills the file step by step
    image[0, 0] = 10 * step
    return make.frames(time_s, dict.fromkeys(("front", "left"), image), step), make.vehicle(time_s)


def record_flight(
    path: Path,
    drone: int = 0,
    *,
    name: str | None = None,
    with_truth: bool = True,
    clock_s: float = 0.0,
    seed: int = 3,
) -> Path:
    """What one of the two drones records; ``seed`` moves the whole flight."""
    config: DroneConfig = drone_config()
    facts = {"scenario": "side_by_side", "seed": str(seed)} if with_truth else {}
    with Recorder(path, drone=name or NAMES[drone], config=config, models=MODELS, facts=facts) as recorder:
        for step in range(STEPS):
            time_s = STEP_S * step
            truth = replace(truth_at(time_s + 0.001 * (seed - 3)), time_s=time_s)
            recorder.drain()
            output = output_of(drone, step, time_s + clock_s)
            recorder.step(*inputs_at(step, time_s + clock_s), output, truth if with_truth else None)
    assert recorder.failure is None
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that two drones of one simulated flight recorded to."""
    folder = tmp_path_factory.mktemp("flight")
    for drone, name in enumerate(NAMES):
        record_flight(folder / f"{name}.mcap", drone)
    return folder


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a real drone recorded, whose clock has run for an hour."""
    return record_flight(
        tmp_path_factory.mktemp("alone") / "kestrel.mcap", name="kestrel", with_truth=False, clock_s=3600
    )


def log_of(*paths: Path) -> FlightLog:
    return flight_log([Recording(path) for path in paths])


def told(capsys: Capture, code: int, *arguments: object) -> tuple[str, str]:
    assert main(["report", *(str(argument) for argument in arguments)]) == code
    captured = capsys.readouterr()
    return captured.out, captured.err


def text_of(page: Path) -> str:
    return " ".join(page.read_text(encoding="utf-8").split())


def test_a_flights_recordings_are_judged_by_the_truth_in_them(flight: Path) -> None:
    (flight / "._a_copy_of_macos.mcap").write_bytes(b"\0\5\x16\7")
    log = log_of(*recordings_in(flight))
    summary = summarise(log)
    assert (summary["drones"], summary["has_truth"], summary["recorded"]) == (2, True, list(NAMES))
    assert (summary["scenario"], summary["seed"], summary["duration_s"]) == ("side_by_side", 3, STEPS * STEP_S)
    before = summary["table2"]["before"]
    assert before["translation_x_m"]["max"] == pytest.approx(LONG_M)
    assert before["yaw_deg"]["max"] == pytest.approx(0.0)
    assert before["distance_m"]["median"] == pytest.approx(0.01 * APART_M)
    assert summary["flock"]["min_distance_m"] == pytest.approx(APART_M)
    assert summary["neighbours"]["recall_within_10m"] == pytest.approx(1 - UNKNOWN_STEPS / STEPS)
    assert summary["neighbours"]["false_per_drone_minute"] == pytest.approx(1 / (2 * STEPS * STEP_S / 60))
    assert summary["stages_ms"]["scene"]["p50"] == pytest.approx(10 + (STEPS - 1) / 2)
    np.testing.assert_allclose(np.linalg.norm(log.truth_position[:, 0] - log.truth_position[:, 1], axis=1), COMPANION_M)
    np.testing.assert_allclose(np.arctan2(log.desired[:, 1], log.desired[:, 0]), log.time_s / 10)


def test_one_drones_recording_tells_of_the_flock_and_of_its_own_sight(flight: Path, capsys: Capture) -> None:
    out, _ = told(capsys, 0, flight / "drone2.mcap", "--without-pictures", "--json", "--out", flight / "of_drone2")
    summary = json.loads(out)
    assert (summary["drones"], summary["recorded"]) == (2, ["drone2"])
    assert summary["flock"]["min_distance_m"] == pytest.approx(APART_M)
    assert summary["neighbours"]["recall_within_10m"] == pytest.approx(1 - UNKNOWN_STEPS / STEPS)
    assert summary["neighbours"]["false_per_drone_minute"] == 0.0  # it was drone1 that saw a ghost
    text = text_of(flight / "of_drone2" / "report.html")
    assert "What was estimated and timed here is by drone2 alone; the truth is of all drones." in text
    assert "holds no truth" not in text
    pictures = {path.name for path in (flight / "of_drone2" / "figures").iterdir()}
    assert pictures == {"trajectories.png", "curves.png", "errors.png"}
    shutil.rmtree(flight / "of_drone2")


def test_the_report_of_a_folder_lies_beside_it_and_stays_unless_it_is_forced(
    flight: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder = tmp_path / "recordings"
    shutil.copytree(flight, folder)
    out, err = told(capsys, 0, folder, "--without-pictures")
    page = tmp_path / "recordings.report" / "report.html"
    assert out.splitlines()[-1] == f"report: {page}"
    assert "holds a flight" not in err
    assert "side_by_side, seed 3, recorded by drone1, drone2" in text_of(page)
    page.write_text("as it was", encoding="utf-8")
    out, err = told(capsys, 0, page.parent)
    assert out.splitlines()[-1] == f"report: {page}"
    assert err.startswith(f"{page}: is left as it was; ")
    assert page.read_text(encoding="utf-8") == "as it was"
    told(capsys, 0, page.parent, "--force")
    assert "Two drones flew 6 s by sight" in text_of(page)


def test_a_step_in_which_the_recorder_was_killed_does_not_count(flight: Path, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "drone1.mcap"
    with McapFile(path) as file:
        for found in read_records(flight / "drone1.mcap"):
            assert not isinstance(found, Damage)
            if not (isinstance(found, Entry) and found.sequence == STEPS - 1 and found.stream in {TRUTH, OUTPUT}):
                file.write(found)
    log = log_of(path)
    assert (log.has_truth, len(log.time_s)) == (True, STEPS - 1), "of the last one truth and output are missing"
    whole, steps = (flight / "drone1.mcap").read_bytes(), []
    for length in np.linspace(len(whole) // 3, 4 * len(whole) // 5, 6).astype(int):
        path.write_bytes(whole[:length])
        log = log_of(path)
        assert log.has_truth
        steps.append(len(log.time_s))
    assert steps == sorted(steps)
    assert 2 < steps[0] < STEPS
    _, err = told(capsys, 0, path, "--without-pictures")
    assert err.startswith(f"{path}: ends early at byte ")
    assert all(line.startswith("writing the report: ") for line in err.splitlines()[1:])


def test_a_replays_recording_keeps_the_truth(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", MadeUpPilot)
    monkeypatch.setattr("flockd.review.replay.recorded_flight.model_hashes", lambda perception: MODELS)
    again = tmp_path / "again.mcap"
    assert main(["replay", str(flight / "drone1.mcap"), "--out", str(again)]) == 0
    flown, replayed = log_of(flight / "drone1.mcap"), log_of(again)
    assert replayed.position.tobytes() == flown.position.tobytes()
    assert replayed.truth_position.tobytes() == flown.truth_position.tobytes()
    assert (replayed.metadata.scenario, replayed.metadata.seed) == ("side_by_side", 3)
    assert replayed.command_velocity.tobytes() != flown.command_velocity.tobytes()  # another pilot's


def test_without_truth_nothing_is_made_up(alone: Path, capsys: Capture) -> None:
    told(capsys, 0, alone, "--without-pictures")
    folder = alone.with_name("kestrel.report")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert not summary["has_truth"]
    of_truth = [*summary["flock"].values(), *summary["neighbours"].values()]
    of_truth += [value for row in summary["table2"].values() for spread in row.values() for value in spread.values()]
    assert set(of_truth) == {None}
    assert summary["own_account"] == {"own_motion_ratio": 1.0, "most_neighbours_tracked": 2}
    text = text_of(folder / "report.html").partition("<svg")[0]
    assert "One drone flew 6 s by sight" in text
    assert "The recording holds no truth, so all of this is the drone’s own estimate." in text
    for claim in ("A flock has two drones or more", "There were no neighbours", "stayed one flock", "nan"):
        assert claim not in text, claim
    assert {path.name for path in (folder / "figures").iterdir()} == {"account.png"}


def test_the_own_account_is_what_was_recorded(alone: Path) -> None:
    log = log_of(alone)
    np.testing.assert_allclose(log.time_s, STEP_S * np.arange(STEPS))  # since the flight began, not of the clock
    np.testing.assert_allclose(log.own_velocity_estimate[1:, 0, 0], 1.04)
    np.testing.assert_allclose(log.command_velocity[:, 0], [[1.0, 0.1]] * STEPS)
    tracked = log.tracked[log.tracked[:, 2] == 7]
    np.testing.assert_allclose(tracked[:, 0], np.arange(UNKNOWN_STEPS, STEPS))
    np.testing.assert_allclose(tracked[:, 4], 1.01 * APART_M)
    assert log.tracked[log.tracked[:, 2] == 9].tolist() == [[5.0, 0.0, 9.0, -20.0, 0.0, 0.0]]


@dataclass
class Looking:
    """A pilot that only looks."""

    config: DroneConfig
    learned: LearnedSize | None

    def step(
        self, frames: FrameSet, vehicle: VehicleState, trace: StepTrace, order: MissionOrder | None = None
    ) -> PilotOutput:
        cameras = {
            name: CameraObservation(
                frame.image,
                RangeMap(np.full((HEIGHT, WIDTH), 3.0, np.float32)),
                np.zeros((HEIGHT, WIDTH), np.uint8),
                None,
            )
            for name, frame in frames.frames.items()
        }
        trace.observation = Observation(frames.time_s, vehicle, cameras, (), None)
        return output_of(0, frames.frames["front"].sequence, frames.time_s)


def test_pictures_are_of_the_recorded_images(alone: Path, flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.review.flight_log.from_recordings.FlockPilot", Looking)
    frames = key_frames(Recording(alone), log_of(alone))
    steps = [1, 11]  # a flight of a few seconds shows its beginning and its end
    assert [frame.time_s for frame in frames] == pytest.approx([STEP_S * step for step in steps])
    assert {frame.title for frame in frames} == {"kestrel"}
    assert [int(frame.images["left"][0, 0, 0]) for frame in frames] == [10 * step for step in steps]
    second = flight / "drone2.mcap"
    assert {frame.title for frame in key_frames(Recording(second), log_of(second))} == {"drone 2"}


def test_of_several_flights_of_a_drone_the_newest_is_told_and_an_earlier_report_stays(
    tmp_path: Path, capsys: Capture
) -> None:
    """As after the second flight of a day: `flockd report recordings`; its clock had been set back by an hour."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name, began in (("kite-2", "2026-11-24T09:30:00+00:00"), ("kite-1", "2026-11-24T10:00:00+00:00")):
        record_flight(tmp_path / "draft.mcap", name="kite", with_truth=False)
        with_facts(tmp_path / "draft.mcap", folder / f"{name}.mcap", began=began, flight_number=name[-1:])
    out, err = told(capsys, 0, folder, "--without-pictures")
    page = folder / "kite-2.report" / "report.html"
    assert out.splitlines()[-1] == f"report: {page}"
    assert f"{folder}: also holds 1 of earlier flights; this is of the newest, kite-2.mcap" in err
    assert "begun 2026-11-24 09:30 UTC" in text_of(page)
    written = page.read_bytes()
    _, err = told(capsys, 2, folder, "--without-pictures")
    assert err.splitlines()[-1].startswith(
        f"{page.parent}: holds a flight; name another folder with --out, or overwrite"
    )
    assert page.read_bytes() == written
    told(capsys, 0, folder, "--without-pictures", "--force")
    told(capsys, 0, folder / "kite-1.mcap", "--without-pictures")
    assert "begun 2026-11-24 10:00 UTC" in text_of(folder / "kite-1.report" / "report.html")


@pytest.mark.parametrize(
    "how",
    [{"seed": 4}, {"with_truth": False}, {"with_truth": False, "first": False}],
    ids=["several flights", "one without truth", "none with truth"],
)
def test_recordings_that_do_not_belong_together_are_refused(
    how: dict[str, Any], tmp_path: Path, capsys: Capture
) -> None:
    folder = tmp_path / "flights"
    folder.mkdir()
    record_flight(folder / "drone1.mcap", 0, with_truth=how.pop("first", True))
    record_flight(folder / "drone2.mcap", 1, **how)
    _, err = told(capsys, 1, folder, "--without-pictures")
    assert err.rstrip().endswith("; name one recording")
    assert [path.name for path in tmp_path.iterdir()] == ["flights"]


@pytest.mark.parametrize("content", [None, b"not a recording", b"\x89MCAP0\r\n", 3000])
def test_what_cannot_be_read_is_one_sentence_and_leaves_nothing(
    content: bytes | int | None, flight: Path, tmp_path: Path, capsys: Capture
) -> None:
    bad = tmp_path / "bad.mcap"
    if content is not None:
        bad.write_bytes(content if isinstance(content, bytes) else (flight / "drone1.mcap").read_bytes()[:content])
    before = set(tmp_path.iterdir())
    _, err = told(capsys, 2 if content is None else 1, bad)
    assert err.startswith(f"{bad}: ")
    assert all(line.startswith("writing the report: ") for line in err.splitlines()[1:])
    assert set(tmp_path.iterdir()) == before
    (tmp_path / "letters.txt").write_text("dear", encoding="utf-8")
    _, err = told(capsys, 2, flight / "drone1.mcap", "--out", tmp_path)
    assert "holds other files than a flight's" in err
    assert "letters.txt" in {path.name for path in tmp_path.iterdir()}
