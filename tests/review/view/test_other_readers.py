"""Recordings are sound MCAP files that others read: by the specification, by Foxglove's schemas, and by Rerun."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf.descriptor_pb2 import DescriptorProto

from flockd.core.config.recording import RecordingConfig
from flockd.onboard.recording.editing import cut, recover
from flockd.onboard.recording.reader import Recording
from tests.onboard.recording.made_up import record
from tests.review.report.test_recordings import record_flight
from tests.review.view.mcap_doctor import decoded, examine, message_class

PUBLISHED = {
    f"foxglove.{kind.__name__}": kind.DESCRIPTOR
    for kind in (CameraCalibration, CompressedImage, FrameTransforms, Log, Odometry)
}
REPLAYED = sorted((Path(__file__).parents[2] / "review" / "replay").glob("*.mcap"))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """What a recorder writes in one file and in several, with truth, cut, recovered after a kill; and older ones."""
    folder = tmp_path_factory.mktemp("files")
    record(folder / "one.mcap")
    record(folder / "several.mcap", settings=RecordingConfig(file_mb=1.0))
    assert len(list(folder.glob("several*.mcap"))) > 1
    record_flight(folder / "simulated.mcap")
    one = Recording(folder / "one.mcap")
    cut(one, folder / "cut.mcap", one.start_s + 0.2, one.start_s + 0.6)
    (folder / "killed").write_bytes((folder / "one.mcap").read_bytes()[:-400_000])
    recover(Recording(folder / "killed"), folder / "recovered.mcap")
    return sorted(folder.glob("*.mcap")) + REPLAYED


def test_a_doctor_finds_nothing(files: list[Path]) -> None:
    for path in files:
        examined = examine(path)
        assert examined.faults == [], path.name
        assert len(examined.messages) > 10


@pytest.mark.parametrize("where", ["message", "index", "statistics"])
def test_the_doctor_would_find_something(where: str, files: list[Path], tmp_path: Path) -> None:
    content = bytearray(files[0].read_bytes())
    summary = int.from_bytes(content[-8 - 20 : -8 - 12], "little")
    content[{"message": len(content) // 2, "index": summary + 400, "statistics": len(content) - 200}[where]] ^= 0x40
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(content)
    try:
        faults = examine(path).faults
    except Exception as error:  # noqa: BLE001 - by whatever a reader notices it
        faults = [str(error)]
    assert faults


def test_foxglove_knows_its_schemas_again(files: list[Path]) -> None:
    """Those in the files, read without our code, are the published ones, and what they describe can be read by them."""
    examined = examine(next(path for path in files if path.name == "one.mcap"))
    kinds = {}
    for schema in examined.schemas.values():
        if schema.encoding == "protobuf":
            ours, published = DescriptorProto(), DescriptorProto()
            message_class(schema).DESCRIPTOR.CopyToProto(ours)
            PUBLISHED[schema.name].CopyToProto(published)
            assert ours == published, schema.name
            kinds[schema.id] = schema.name
    assert set(kinds.values()) == PUBLISHED.keys()
    read: dict[str, list[object]] = {}
    for message in examined.messages:
        channel = examined.channels[message.channel_id]
        read.setdefault(channel.topic, []).append(decoded(examined, message))
    image, path, frames = read["/camera/front/image"][0], read["/odometry"][-1], read["/tf"][0]
    assert (image.frame_id, image.format, image.data[:4]) == ("front", "png", b"\x89PNG")  # type: ignore[attr-defined]
    assert (path.frame_id, path.body_frame_id) == ("local", "body")  # type: ignore[attr-defined]
    children = [one.child_frame_id for one in frames.transforms]  # type: ignore[attr-defined]
    assert children == ["body", "front", "left"]


# --------------------------------------------------------------------------------------------------------------- Rerun


def rerun_says(*arguments: str, home: Path) -> str:
    environment = {**os.environ, "CI": "1", "HOME": str(home)}
    command = [sys.executable, "-m", "rerun_cli", "mcap", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return re.sub(r"\x1b\[\d*m", "", done.stdout + done.stderr)


def test_reruns_own_check_finds_nothing(files: list[Path], tmp_path: Path) -> None:
    """Of flights whose cameras' clocks ran: one of the recorded faults is a time that goes back."""
    for path in (path for path in files if path.name != "faults.mcap"):
        rows = [line.split() for line in rerun_says("check", "--full", str(path), home=tmp_path).splitlines()]
        streams = [row for row in rows if any(cell.startswith("/") for cell in row[3:4])]
        assert len(streams) >= 10, path.name
        assert {(row[0], row[-1]) for row in streams} == {("ok", "—")}, path.name


def test_reruns_loader_shows_images_cameras_places_and_log(files: list[Path], tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    path = next(path for path in files if path.name == "one.mcap")
    target = tmp_path / "one.rrd"
    rerun_says("convert", str(path), "-o", str(target), home=tmp_path)
    rows: dict[tuple[str, str], int] = {}
    for chunk in RrdReader(target).stream():
        for name in chunk.to_record_batch().schema.names:
            kind = name.partition(":")[0]
            rows[str(chunk.entity_path), kind] = rows.get((str(chunk.entity_path), kind), 0) + chunk.num_rows
    for camera in ("front", "left"):
        assert rows[f"/camera/{camera}/image", "EncodedImage"] >= 10
        assert rows[f"/camera/{camera}/calibration", "Pinhole"] >= 1
    assert rows["/tf", "Transform3D"] >= 10 * 3
    assert rows["/log", "TextLog"] >= 10
