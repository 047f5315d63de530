"""What is damaged or hostile inside a message, behind correct checksums, found by changing records at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.editing import recover
from flockd.onboard.recording.export import export_images, export_tables
from flockd.onboard.recording.mcap_file import Entry, Record
from flockd.onboard.recording.reader import Recording
from tests.onboard.recording.made_up import record, rewritten

pytestmark = pytest.mark.fault("hostile-recording")

STEPS = 3
DEEP = b"[" * 100_000


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "drone1.mcap"
    record(path, STEPS)
    return path


def changed(whole: Path, path: Path, topic: str, change: Callable[[Entry], Entry], step: int = 1) -> Path:
    """A copy with one message changed, all checksums right."""

    def in_its_step(found: Record) -> Record:
        hit = isinstance(found, Entry) and found.stream.topic == topic and found.sequence == step
        return change(found) if hit else found  # type: ignore[arg-type]

    return rewritten(whole, path, in_its_step)


@pytest.mark.parametrize("topic", ["/vehicle", "/output"])
@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b"[1]", b'"x"', DEEP], ids=["none", "open", "utf8", "list", "text", "deep"]
)
def test_a_step_with_a_damaged_message_is_named_and_recovered_without(
    tmp_path: Path, whole: Path, topic: str, data: bytes
) -> None:
    path = changed(whole, tmp_path / "x.mcap", topic, lambda entry: replace(entry, data=data))
    if (topic, data) not in {("/output", b"[1]"), ("/output", b'"x"')}:  # an output is only compared, not flown
        with pytest.raises(RecordingError, match=r"step 1 cannot be read .*record recover"):
            list(Recording(path).steps())
        assert recover(Recording(path), tmp_path / "y.mcap") == STEPS - 1
        assert [step.number for step in Recording(tmp_path / "y.mcap").steps()] == [0, 2]


@pytest.mark.parametrize("topic", ["/../../out", "/..", "/a/b", "/.hidden", "/a\x1b[2J", "/" + "a" * 300])
def test_no_name_in_a_recording_leads_out_of_the_folder_of_an_export(tmp_path: Path, whole: Path, topic: str) -> None:
    def renamed(entry: Entry) -> Entry:
        return replace(entry, stream=replace(entry.stream, topic=topic))

    folder = tmp_path / "a" / "tables"
    folder.mkdir(parents=True)
    path = changed(whole, tmp_path / "x.mcap", "/output", renamed)
    with pytest.raises(RecordingError, match="which is none for a file"):
        export_tables(Recording(path), folder)
    assert {found.name for found in tmp_path.rglob("*.csv")} <= {found.name for found in folder.rglob("*.csv")}


@pytest.mark.parametrize(("camera", "kind"), [("..", "png"), ("front", "/../../../out")])
def test_no_image_is_written_outside_either(tmp_path: Path, whole: Path, camera: str, kind: str) -> None:
    def renamed(entry: Entry) -> Entry:
        message = CompressedImage(frame_id=camera, data=b"x", format=kind).SerializeToString()
        return replace(entry, stream=replace(entry.stream, topic=f"/camera/{camera}/image"), data=message)

    folder = tmp_path / "a" / "images"
    path = changed(whole, tmp_path / "x.mcap", "/camera/front/image", renamed, step=2)
    with pytest.raises(RecordingError, match="which is none for a file"):
        export_images(Recording(path), folder)
    assert all(folder in found.parents for found in tmp_path.rglob("*.png"))
