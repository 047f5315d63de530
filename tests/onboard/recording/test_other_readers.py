"""Recordings are sound MCAP files that others read: by the specification, and by Foxglove's schemas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Message, Schema

from tests.onboard.recording.made_up import record
from tests.review.report.test_recordings import record_flight

PUBLISHED = {
    f"foxglove.{kind.__name__}": kind.DESCRIPTOR
    for kind in (CameraCalibration, CompressedImage, FrameTransforms, Log, Odometry)
}
REPLAYED = sorted((Path(__file__).parents[2] / "review" / "replay").glob("*.mcap"))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """What a recorder writes, also with truth; and older ones."""
    folder = tmp_path_factory.mktemp("files")
    record(folder / "one.mcap")
    record_flight(folder / "simulated.mcap")
    return sorted(folder.glob("*.mcap")) + REPLAYED


Read = list[tuple[Schema, Channel, Message]]


def examined(path: Path) -> Read:
    """All messages, read by the format's own library from begin to end and again by the index, checksums compared."""
    with path.open("rb") as file:
        indexed = list(SeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))
    with path.open("rb") as file:
        in_order = list(NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))
    assert indexed == in_order
    return [(schema, channel, message) for schema, channel, message in in_order if schema is not None]


def decoded(schema: Schema, message: Message) -> Any:
    """A message by nothing but the schema in the file: JSON with the fields that it names, or protobuf."""
    if schema.encoding == "protobuf":
        return message_class(schema).FromString(message.data)
    value, described = json.loads(message.data), json.loads(schema.data)
    assert set(described["required"]) <= value.keys() <= described["properties"].keys()
    return value


def message_class(schema: Schema) -> Any:
    """The class of a protobuf message, from its descriptors alone."""
    pool = DescriptorPool()
    for one in FileDescriptorSet.FromString(schema.data).file:  # imports first
        pool.Add(one)
    return GetMessageClass(pool.FindMessageTypeByName(schema.name))


def test_the_formats_own_library_reads_all(files: list[Path]) -> None:
    for path in files:
        read = examined(path)
        assert len(read) >= 10, path.name
        for schema, _, message in read:
            assert decoded(schema, message) is not None


def test_foxglove_knows_its_schemas_again(files: list[Path]) -> None:
    """Those in the files, read without our code, are the published ones, and what they describe can be read by them."""
    messages = examined(next(path for path in files if path.name == "one.mcap"))
    kinds = {}
    for schema in {schema.id: schema for schema, _, _ in messages if schema.encoding == "protobuf"}.values():
        ours, published = DescriptorProto(), DescriptorProto()
        message_class(schema).DESCRIPTOR.CopyToProto(ours)
        PUBLISHED[schema.name].CopyToProto(published)
        assert ours == published, schema.name
        kinds[schema.id] = schema.name
    assert set(kinds.values()) == PUBLISHED.keys()
    read: dict[str, list[Any]] = {}
    for schema, channel, message in messages:
        read.setdefault(channel.topic, []).append(decoded(schema, message))
    image, path, frames = read["/camera/front/image"][0], read["/odometry"][-1], read["/tf"][0]
    assert (image.frame_id, image.format, image.data[:4]) == ("front", "png", b"\x89PNG")
    assert (path.frame_id, path.body_frame_id) == ("local", "body")
    children = [one.child_frame_id for one in frames.transforms]
    assert children == ["body", "front", "left"]
