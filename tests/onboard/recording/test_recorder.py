"""A recording is complete, opens elsewhere, and never stands in the flight's way."""

from __future__ import annotations

import os
import resource
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from mcap.reader import NonSeekingReader, make_reader
from scipy.spatial.transform import Rotation

from flockd.core.config import DroneConfig
from flockd.core.config.drone import RecordingConfig
from flockd.flight.geometry import build_rig
from flockd.onboard.recording import Recorder
from flockd.onboard.recording import recorder as recorder_module
from flockd.onboard.recording.mcap_file import McapFile
from flockd.onboard.recording.reader import Recording
from tests.onboard.recording.made_up import MODELS, MadeUpPilot, drone_config, inputs, record

CAMERAS = ("front", "left")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "drone1.mcap"
    record(path)
    return path


def messages(path: Path, topic: str) -> list[tuple[Any, Any]]:
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(topics=topic, log_time_order=False)
        return [(schema, message) for schema, _, message in found]


def test_another_reader_finds_every_stream_and_a_sound_index(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        names = {note.name for note in reader.iter_metadata()}
        (configuration,) = reader.iter_attachments()
    assert summary is not None and summary.statistics is not None
    counts = {
        summary.channels[number].topic: count for number, count in summary.statistics.channel_message_counts.items()
    }
    once = {f"/camera/{camera}/calibration" for camera in CAMERAS}
    each_step = {f"/camera/{camera}/image" for camera in CAMERAS} | {"/frames", "/vehicle", "/output", "/tf"}
    each_step |= {"/odometry", "/log"}
    assert counts == dict.fromkeys(once, 1) | dict.fromkeys(each_step, 10)
    assert names == {"flockd", "models", "end"}
    assert DroneConfig.model_validate_json(configuration.data) == drone_config()
    assert max(index.uncompressed_size for index in summary.chunk_indexes) < 100_000 + 3 * 160 * 120 + 1000
    with path.open("rb") as file:
        assert sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages()) == sum(counts.values())


def test_viewers_get_cameras_where_they_are(path: Path) -> None:
    rig = build_rig(drone_config().rig)
    (_, vehicle), _ = inputs(2)
    tree = FrameTransforms.FromString(messages(path, "/tf")[0][1].data)
    body, *mounted = tree.transforms
    assert (body.parent_frame_id, body.child_frame_id) == ("local", "body")
    assert body.translation.z == -vehicle.height_m
    for transform in mounted:
        q = transform.rotation
        found = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        expected = rig.cameras[transform.child_frame_id].T_body_camera
        assert np.allclose(found, expected.rotation, atol=1e-12)
        assert [transform.translation.x, transform.translation.y, transform.translation.z] == list(expected.translation)
    calibration = CameraCalibration.FromString(messages(path, "/camera/front/calibration")[0][1].data)
    assert list(calibration.K) == [80.0, 0.0, 79.0, 0.0, 81.0, 59.75, 0.0, 0.0, 1.0], "pixel centres at whole numbers"


def test_steps_come_back_with_every_pixel_and_every_bit(path: Path) -> None:
    recording = Recording(path)
    assert (recording.drone, recording.config, recording.contents.models) == ("drone1", drone_config(), MODELS)
    assert recording.contents.finished
    flown = list(inputs(10))
    for step, (frames, vehicle) in zip(recording.steps(), flown, strict=True):
        assert step.frames.time_s == frames.time_s
        assert step.vehicle.R_ned_body.tobytes() == vehicle.R_ned_body.tobytes()
        assert step.vehicle.height_m == vehicle.height_m
        assert (step.vehicle.velocity_ned is None) == (vehicle.velocity_ned is None)
        for name, frame in frames.frames.items():
            back = step.frames.frames[name]
            assert (back.time_s, back.sequence) == (frame.time_s, frame.sequence)
            assert np.array_equal(back.image, frame.image)


def test_jpeg_is_smaller_and_near(tmp_path: Path) -> None:
    smooth = np.repeat(np.linspace(0, 255, 160).astype(np.uint8)[None, :, None], 120, 0).repeat(3, 2)
    frames, vehicle = next(inputs(1))
    object.__setattr__(frames.frames["left"], "image", smooth)
    record(tmp_path / "drone1.mcap", [(frames, vehicle)], RecordingConfig(images="jpeg"))
    (step,) = Recording(tmp_path / "drone1.mcap").steps()
    assert cv2.PSNR(step.frames.frames["left"].image, smooth) > 40.0
    assert not np.array_equal(step.frames.frames["front"].image, frames.frames["front"].image)


def test_a_frame_that_is_no_image_is_left_out_and_reported(tmp_path: Path) -> None:
    told: list[str] = []
    frames, vehicle = next(inputs(1))
    object.__setattr__(frames.frames["left"], "image", np.zeros((0, 0, 3), np.uint8))
    record(tmp_path / "drone1.mcap", [(frames, vehicle)], told=told)
    (step,) = Recording(tmp_path / "drone1.mcap").steps()
    assert set(step.frames.frames) == {"front"}
    assert len(told) == 1 and "camera left" in told[0]
    assert len(messages(tmp_path / "drone1.mcap", "/events")) == 1


@pytest.mark.fault("foreign-recordings")
def test_what_is_no_readable_file_in_the_folder_is_skipped_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "dangling.mcap").symlink_to(tmp_path / "nowhere")
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "damaged.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\xff" * 100)
    odd, told = sorted(path.name for path in tmp_path.iterdir()), list[str]()
    record(tmp_path / "drone1.mcap", 1, told=told)
    assert len(list(Recording(tmp_path / "drone1.mcap").steps())) == 1
    for name in odd:
        assert sum(name in text and "skipped" in text for text in told) == 1, name


def test_a_disk_that_never_answers_costs_steps_but_no_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, answers = tmp_path / "drone1.mcap", threading.Event()
    told: list[str] = []

    def opened(path: Path) -> McapFile:
        answers.wait()
        return McapFile(path)

    monkeypatch.setattr(recorder_module, "McapFile", opened)
    config = drone_config()
    recorder = Recorder(
        path, drone="drone1", config=config, settings=RecordingConfig(queue_mb=1.0), on_event=told.append
    )
    pilot = MadeUpPilot(config)
    flown = [(frames, vehicle, pilot.step(frames, vehicle)) for frames, vehicle in inputs(30)]
    for step in flown:
        recorder.step(*step)
    fit = 1e6 // (2 * 160 * 120 * 3 + 4096)
    assert recorder.lost == 30 - fit
    assert sum("dropped" in event for event in told) == 1
    recorder.close(timeout_s=0.2)
    assert "too slow to end it" in told[-1]
    answers.set()  # none of these waited for the disk


def test_two_recordings_that_begin_in_one_microsecond_are_both_kept(tmp_path: Path) -> None:
    """As of two boots without a clock: the name is of the time."""
    path, told = tmp_path / "drone1-19700101T000012000000Z.mcap", list[str]()
    record(path, 4)
    for number in (2, 3):
        record(path, number, told=told)
        assert len(list(Recording(path.with_stem(f"{path.stem}-{number}")).steps())) == number
    assert len(list(Recording(path).steps())) == 4
    assert [text for text in told if "exists, so that the recording is" in text] == told != []


@contextmanager
def small_disk(folder: Path, kind: str) -> Iterator[None]:
    """Room for about 1 MB: a file system that is no larger, or a limit to a file's size that the system enforces."""
    if kind == "tmpfs":
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(folder)], capture_output=True, check=False
        )
        if mounted.returncode:
            pytest.skip("a small file system cannot be mounted here")
        try:
            yield
        finally:
            subprocess.run(["umount", "-l", str(folder)], check=True)
    else:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.fault("disk-full")
@pytest.mark.parametrize(("kind", "reason"), [("tmpfs", "no space left on device"), ("limit", "file too large")])
def test_a_full_disk_ends_the_recording_and_not_the_flight(tmp_path: Path, kind: str, reason: str) -> None:
    told: list[str] = []
    config = drone_config()
    free, recorded = MadeUpPilot(config), MadeUpPilot(config)
    path = tmp_path / "drone1.mcap"
    with small_disk(tmp_path, kind):
        with Recorder(path, drone="drone1", config=config, on_event=told.append) as recorder:
            for frames, vehicle in inputs(30):
                output = recorded.step(frames, vehicle)
                recorder.drain()
                recorder.step(frames, vehicle, output)
                assert output.command.yaw_rad == free.step(frames, vehicle).command.yaw_rad
        assert len(told) == 1 and told[0].startswith(f"recording {path}: {reason}; ")
        assert recorder.failure == told[0]
        assert recorder.lost > 15
        assert str(path) not in {f"{fd.readlink()}" for fd in Path("/proc/self/fd").iterdir() if fd.is_symlink()}
        recording = Recording(path)
        assert not recording.contents.finished
        kept = list(recording.steps())
    assert [step.number for step in kept] == list(range(len(kept)))
    assert len(kept) >= 5


def test_nowhere_to_write_is_reported_once_and_does_not_raise(tmp_path: Path) -> None:
    told: list[str] = []
    path = tmp_path / "missing" / "drone1.mcap"
    record(path, 3, told=told)
    assert len(told) == 1 and told[0].startswith(f"recording {path}: no such file or directory; ")
