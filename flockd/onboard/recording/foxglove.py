"""The adapter of Foxglove's well-known schemas (protobuf), which its app and Rerun show without additions.

Frames: `local` points north, east and down from where the recording began, `body` is FRD, and each camera's frame has
the camera's name and is RDF.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from scipy.spatial.transform import Rotation

from flockd.core.choices import ImageFormat
from flockd.core.config.rig import CameraConfig
from flockd.core.messages import FloatArray
from flockd.flight.geometry import Rig
from flockd.onboard.recording.mcap_file import RecordingError, Stream
from flockd.onboard.sources.ros_device import CENTRE_PX


def image(time_ns: int, camera: str, data: bytes, kind: ImageFormat) -> bytes:
    """A CompressedImage."""
    return _packed(CompressedImage, time_ns, frame_id=camera, data=data, format=kind)


def image_data(message: bytes) -> tuple[bytes, str]:
    """The compressed image in a CompressedImage, and its format. Raises RecordingError."""
    decoded = CompressedImage()
    try:
        decoded.ParseFromString(message)
    except DecodeError as error:
        raise RecordingError(f"an image message cannot be read ({error})") from error
    return decoded.data, decoded.format


def calibration(time_ns: int, camera: CameraConfig) -> bytes:
    """A CameraCalibration, in which pixel centres are whole numbers."""
    lens, (width, height) = camera.intrinsics, camera.size_px
    cx, cy = lens.cx - CENTRE_PX, lens.cy - CENTRE_PX
    model, coefficients = ("plumb_bob", 5) if lens.model == "pinhole" else ("kannala_brandt", 4)
    return _packed(
        CameraCalibration,
        time_ns,
        frame_id=camera.name,
        width=width,
        height=height,
        distortion_model=model,
        D=lens.distortion or (0.0,) * coefficients,
        K=(lens.fx, 0.0, cx, 0.0, lens.fy, cy, 0.0, 0.0, 1.0),
        R=np.eye(3).ravel(),
        P=(lens.fx, 0.0, cx, 0.0, 0.0, lens.fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
    )


def transforms(time_ns: int, position: FloatArray, R_ned_body: FloatArray, rig: Rig) -> bytes:
    """FrameTransforms of the body in `local` and of each camera in the body."""
    mounted = {name: camera.T_body_camera for name, camera in rig.cameras.items()}
    places = [
        ("local", "body", position, R_ned_body),
        *(("body", name, place.translation, place.rotation) for name, place in mounted.items()),
    ]
    named: list[Any] = [
        {
            "timestamp": _stamp(time_ns),
            "parent_frame_id": parent,
            "child_frame_id": child,
            "translation": _vector(place),
            "rotation": _turn(R),
        }
        for parent, child, place, R in places
    ]
    return bytes(FrameTransforms(transforms=named).SerializeToString())


def odometry(time_ns: int, position: FloatArray, R_ned_body: FloatArray, velocity_ned: FloatArray) -> bytes:
    """An Odometry: the path integrated from the own velocity."""
    pose = {"position": _vector(position), "orientation": _turn(R_ned_body)}
    velocity = _vector(R_ned_body.T @ velocity_ned)
    frames = {"frame_id": "local", "body_frame_id": "body"}
    return _packed(Odometry, time_ns, **frames, pose=pose, linear_velocity=velocity)


def log(time_ns: int, level: Literal["INFO", "WARNING"], text: str) -> bytes:
    """A Log."""
    return _packed(Log, time_ns, level=level, message=text, name="flockd")


def _packed(kind: Any, time_ns: int, **fields: Any) -> bytes:
    return bytes(kind(timestamp=_stamp(time_ns), **fields).SerializeToString())


def _vector(values: FloatArray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _turn(R: FloatArray) -> dict[str, float]:
    return dict(zip("xyzw", Rotation.from_matrix(R).as_quat(canonical=True).tolist(), strict=True))


def _stamp(time_ns: int) -> dict[str, int]:
    return {"seconds": time_ns // 10**9, "nanos": time_ns % 10**9}


def _descriptor_set(file: Any) -> bytes:
    """A schema with all its imports, imports first."""
    found: dict[str, Any] = {}

    def visit(one: Any) -> None:
        for imported in one.dependencies:
            visit(imported)
        found.setdefault(one.name, one)

    visit(file)
    descriptors = FileDescriptorSet()
    for one in found.values():
        one.CopyToProto(descriptors.file.add())
    return bytes(descriptors.SerializeToString(deterministic=True))


def _stream(topic: str, message: Any) -> Stream:
    return Stream(topic, "protobuf", message.DESCRIPTOR.full_name, _descriptor_set(message.DESCRIPTOR.file))


@cache
def image_stream(camera: str) -> Stream:
    """The stream of a camera's images."""
    return _stream(f"/camera/{camera}/image", CompressedImage)


@cache
def calibration_stream(camera: str) -> Stream:
    """The stream of a camera's calibration."""
    return _stream(f"/camera/{camera}/calibration", CameraCalibration)


TRANSFORMS = _stream("/tf", FrameTransforms)
ODOMETRY = _stream("/odometry", Odometry)
LOG = _stream("/log", Log)
