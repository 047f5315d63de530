"""The one adapter to Foxglove's well-known schemas (protobuf): what its app and Rerun show with nothing added.

Places are in the drone's own axes: `local` points north, east and down from where the recording began, `body` is FRD,
and each camera's frame carries the camera's name and is RDF.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from scipy.spatial.transform import Rotation

from flockd.core.choices import ImageFormat
from flockd.core.config.rig import CameraConfig, RigConfig
from flockd.core.messages import FloatArray
from flockd.onboard.recording.mcap_file import RecordingError, Stream

_FRD_RDF = Rotation.from_quat((0.5, 0.5, 0.5, 0.5))
"""From a camera's axes (right, down, forward) to those of a body that faces along it."""
_CENTRE_PX = 0.5
"""Pixel centres lie at whole numbers in Foxglove, as in OpenCV, and half a pixel farther here."""


def image(time_ns: int, camera: str, data: bytes, kind: ImageFormat) -> bytes:
    """A CompressedImage."""
    message = CompressedImage(frame_id=camera, data=data, format=kind)
    message.timestamp.FromNanoseconds(time_ns)
    return bytes(message.SerializeToString())


def image_data(message: bytes) -> tuple[bytes, str]:
    """The compressed image in a CompressedImage, and its format. Raises RecordingError."""
    decoded = CompressedImage()
    try:
        decoded.ParseFromString(message)
    except DecodeError as error:
        raise RecordingError(f"an image message cannot be read ({error})") from error
    return decoded.data, decoded.format


def calibration(time_ns: int, camera: CameraConfig) -> bytes:
    """A CameraCalibration."""
    intrinsics = camera.intrinsics
    (width, height), fx, fy = camera.size_px, intrinsics.fx, intrinsics.fy
    cx, cy = intrinsics.cx - _CENTRE_PX, intrinsics.cy - _CENTRE_PX
    message = CameraCalibration(
        frame_id=camera.name,
        width=width,
        height=height,
        distortion_model="plumb_bob" if intrinsics.model == "pinhole" else "kannala_brandt",
        D=intrinsics.distortion or (0.0,) * (5 if intrinsics.model == "pinhole" else 4),
        K=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        R=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        P=(fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
    )
    message.timestamp.FromNanoseconds(time_ns)
    return bytes(message.SerializeToString())


def transforms(time_ns: int, position: FloatArray, R_ned_body: FloatArray, rig: RigConfig) -> bytes:
    """FrameTransforms of the body in `local` and of each camera in the body."""
    message = FrameTransforms()
    _add(message, time_ns, ("local", "body"), position.tolist(), Rotation.from_matrix(R_ned_body))
    for camera in rig.cameras:
        _add(message, time_ns, ("body", camera.name), camera.extrinsics.position_m, _mounting(camera))
    return bytes(message.SerializeToString())


def odometry(time_ns: int, position: FloatArray, R_ned_body: FloatArray, velocity_ned: FloatArray) -> bytes:
    """An Odometry: the path that adds up from the own velocity."""
    message = Odometry(frame_id="local", body_frame_id="body")
    message.timestamp.FromNanoseconds(time_ns)
    _set_vector(message.pose.position, position.tolist())
    _set_rotation(message.pose.orientation, Rotation.from_matrix(R_ned_body))
    _set_vector(message.linear_velocity, (R_ned_body.T @ velocity_ned).tolist())
    return bytes(message.SerializeToString())


def log(time_ns: int, level: Literal["INFO", "WARNING"], text: str) -> bytes:
    """A Log."""
    message = Log(level=Log.Level.Value(level), message=text, name="flockd")
    message.timestamp.FromNanoseconds(time_ns)
    return bytes(message.SerializeToString())


def _descriptor_set(file: Any) -> bytes:
    """A schema with all that it imports, imports first."""
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


def _mounting(camera: CameraConfig) -> Rotation:
    """From the camera's axes to the body's: yaw, then pitch, then roll of a camera that faces forward."""
    extrinsics = camera.extrinsics
    angles = (extrinsics.yaw_deg, extrinsics.pitch_deg, extrinsics.roll_deg)
    return Rotation.from_euler("ZYX", angles, degrees=True) * _FRD_RDF


def _add(message: Any, time_ns: int, frames: tuple[str, str], place: Any, turn: Rotation) -> None:
    transform: FrameTransform = message.transforms.add()
    transform.timestamp.FromNanoseconds(time_ns)
    transform.parent_frame_id, transform.child_frame_id = frames
    _set_vector(transform.translation, place)
    _set_rotation(transform.rotation, turn)


def _set_vector(target: Any, values: Any) -> None:
    target.x, target.y, target.z = values


def _set_rotation(target: Any, rotation: Rotation) -> None:
    target.x, target.y, target.z, target.w = rotation.as_quat(canonical=True).tolist()


def _stream(topic: str, message: Any) -> Stream:
    return Stream(topic, "protobuf", message.DESCRIPTOR.full_name, _descriptor_set(message.DESCRIPTOR.file))


@cache
def image_stream(camera: str) -> Stream:
    """The stream of a camera's images."""
    return _stream(f"/camera/{camera}/image", CompressedImage)


@cache
def calibration_stream(camera: str) -> Stream:
    """Where a camera's calibration goes."""
    return _stream(f"/camera/{camera}/calibration", CameraCalibration)


TRANSFORMS = _stream("/tf", FrameTransforms)
ODOMETRY = _stream("/odometry", Odometry)
LOG = _stream("/log", Log)
