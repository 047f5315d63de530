"""A bag of ROS 2, in MCAP or SQLite, becomes a recording that can be replayed: its images, with odometry or an IMU.

The one adapter to `rosbags`, which reads it without ROS.
"""

from __future__ import annotations

import json
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
from scipy.integrate import cumulative_trapezoid

from flockd.core.choices import ImageFormat
from flockd.core.config import DroneConfig
from flockd.core.config.source import CameraDeviceParameters
from flockd.core.errors import UsageError
from flockd.core.messages import UInt8Array, VehicleState
from flockd.fleet.ros.message_trees import COMPRESSED_IMAGE
from flockd.fleet.ros.ros_input import (
    LONGEST_GAP_S,
    STATES,
    NearestState,
    RosImage,
    check_height,
    image_of,
    stamp_ns,
    state_stamp_ns,
    vehicle_state,
)
from flockd.flight.inference.manifest_file import model_hashes
from flockd.onboard.message_json import to_json
from flockd.onboard.recording import RecordingError, foxglove
from flockd.onboard.recording.mcap_file import Entry, Inclosure, McapFile, Note
from flockd.onboard.recording.streams import (
    CONFIGURATION,
    END_NOTE,
    FLIGHT_NOTE,
    FORMAT,
    FRAMES,
    MODELS_NOTE,
    VEHICLE,
    FrameEntry,
    StepFrames,
    is_image,
    nanoseconds,
)
from flockd.onboard.sources import image_formats
from flockd.onboard.sources.assembler import Assembler, RawFrameSet
from flockd.onboard.sources.camera_child import numbers_of
from flockd.onboard.sources.device_source import frames_of
from flockd.onboard.sources.frames import CapturedBuffer
from flockd.onboard.sources.image_formats import CorruptImageError, MjpegFormat
from flockd.onboard.sources.ros_device import info_fault, info_topic_of, ros_format

IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"


def recording_of_bag(
    bag: Bag,
    config: DroneConfig,
    vehicle_topic: str | None,
    target: Path,
    tell: Callable[[str], None] = lambda sentence: None,
) -> int:
    """Writes a recording of the bag's frame sets to ``target``, a step every ``config.step_s``; returns their number.

    ``config.source``, of kind `ros`, names the cameras' topics; ``vehicle_topic`` is that of the vehicle's state, None:
    the only one of the best kind. ``tell`` is called with a sentence about images that could not be used. Raises
    UsageError and RecordingError.
    """
    source = config.source
    if source is None or source.kind != "ros":
        raise UsageError(
            f"{bag.path}: is a bag of ROS 2; replay it with --config, a drone's whose source.kind is `ros` and whose "
            "cameras name their topics"
        )
    topics: dict[str, list[CameraDeviceParameters]] = {}
    for camera in source.cameras:
        topics.setdefault(camera.place, []).append(camera)
    kinds = bag.kinds()
    for topic, cameras in topics.items():
        if kinds.get(topic) not in {IMAGE, COMPRESSED_IMAGE}:
            there = ", ".join(name for name, kind in kinds.items() if kind in {IMAGE, COMPRESSED_IMAGE}) or "none"
            told = f"has no images of camera {cameras[0].name} in {topic}; topics with images: {there}"
            raise UsageError(f"{bag.path}: {told}")
    _compare_lenses(bag, config, kinds)
    began_ns = next((stamp_ns(bag.read(one)) for one in bag.messages(topics)), 0)
    states = _states(bag, _vehicle_topic(bag, vehicle_topic), config, began_ns, tell)
    steps, kept, lost = 0, 0, Counter[str]()
    times: dict[str, list[tuple[int, int]]] = {}
    with McapFile(target) as file:
        facts = {"format": FORMAT, "drone": config.name, "images": "png", "recording": uuid.uuid4().hex}
        file.write(Note(FLIGHT_NOTE, {**facts, "from_bag": bag.path.name}))
        file.write(Note(MODELS_NOTE, model_hashes(config.perception)))
        file.write(Inclosure(CONFIGURATION, "application/json", config.model_dump_json(indent=1).encode()))
        last_s = -np.inf
        for frames in _sets(bag, topics, config, began_ns, lost, times):
            vehicle = states.at(frames.time_s + config.rig.time_offset_s)
            if vehicle is None:
                lost[f"all cameras: no state of the vehicle within {LONGEST_GAP_S:g} s"] += len(frames.frames)
                continue
            if frames.time_s < last_s + config.step_s - source.set_tolerance_s:
                continue
            last_s = frames.time_s
            for entry in _entries(steps, frames, vehicle, lost):
                file.write(entry)
                kept += is_image(entry.stream.topic)
            steps += 1
        file.write(Note(END_NOTE, {"steps": str(steps), "lost": "0"}))
    _check_stamps(bag, times)
    if steps == 0:
        raise RecordingError(
            f"{bag.path}: has no image with a state of the vehicle within {LONGEST_GAP_S:g} s of it; are their stamps "
            "of one clock?"
        )
    why = "; ".join(f"{count} of {fault}" for fault, count in lost.most_common(4))
    if kept == 0:
        raise RecordingError(f"{bag.path}: none of its images could be used ({why}); correct the rig, or the bag")
    if lost:
        tell(f"{bag.path}: {lost.total()} images could not be used: {why}")
    return steps


def _compare_lenses(bag: Bag, config: DroneConfig, kinds: Mapping[str, str]) -> None:
    """Raises RecordingError where a CameraInfo contradicts the rig, as in flight."""
    assert config.source is not None
    lenses = {camera.name: (camera.intrinsics, camera.size_px) for camera in config.rig.cameras}
    for camera in (one for one in config.source.cameras if one.crop is None):
        topic = camera.camera_info or info_topic_of(camera.place)
        if kinds.get(topic) != CAMERA_INFO or (message := next(bag.messages([topic]), None)) is None:
            continue
        if (fault := info_fault(*lenses[camera.name], camera.place, numbers_of(bag.read(message)))) is not None:
            raise RecordingError(f"{bag.path}: camera {camera.name}: {topic} {fault}")


_PACE = 20.0
"""Most by which a simulator's time is slower or faster than the recorder's clock."""


def _check_stamps(bag: Bag, times: Mapping[str, Sequence[tuple[int, int]]]) -> None:
    """Raises RecordingError where images' stamps do not advance as the time does in which they were recorded."""
    for topic, both in times.items():
        stamps_s, recorded_s = (1e-9 * (last - first) for first, last in zip(both[0], both[-1], strict=True))
        if len(both) > 1 and not recorded_s / _PACE <= stamps_s <= recorded_s * _PACE:
            raise RecordingError(
                f"{bag.path}: stamps of {topic} advance by {stamps_s:g} s in the {recorded_s:g} s in which they were "
                "recorded; correct their publisher's clock or its unit"
            )


def _sets(
    bag: Bag,
    topics: Mapping[str, Sequence[CameraDeviceParameters]],
    config: DroneConfig,
    began_ns: int,
    lost: Counter[str],
    times: dict[str, list[tuple[int, int]]],
) -> Iterator[RawFrameSet]:
    """Frames by their stamps, as a drone puts them together; the clock begins with the first one's.

    ``times`` gets each topic's stamps, and the times at which they were recorded, ns.
    """
    assert config.source is not None
    sizes = {camera.name: camera.size_px for camera in config.rig.cameras}
    assembler = Assembler(tuple(sizes), config.source)
    last: dict[str, CapturedBuffer] = {}
    for message in bag.messages(topics):
        cameras = topics[message.topic]
        first = cameras[0]
        size = sizes[first.name] if first.crop is None else config.source.whole_px(first)
        image = image_of(bag.read(message))
        times.setdefault(message.topic, []).append((image.stamp_ns, message.time_ns))
        time_s, number = _time_s(image.stamp_ns, began_ns), 0
        if (before := last.get(message.topic)) is not None:
            number = before.sequence + max(round((time_s - before.time_s) * first.rate_hz), 1)
        captured = CapturedBuffer(image.data, time_s, number, flagged=False)
        for frame in frames_of(cameras, captured, _format(image, size, first.size_words, message)):
            if (fault := assembler.offer(frame, time_s)) is not None:
                lost[f"camera {frame.camera}: {fault}"] += 1
            else:
                last[message.topic] = captured
        if last.get(message.topic) is captured and (found := assembler.take(time_s)) is not None:
            yield found
    if (found := assembler.take(np.inf)) is not None:
        yield found


def _time_s(stamp_ns: int, began_ns: int) -> float:
    """Since the first image: a float of the seconds since 1970 would hold no microseconds."""
    return (stamp_ns - began_ns) * 1e-9


def _format(
    image: RosImage, size: tuple[int, int], words: tuple[str, str], message: BagMessage
) -> image_formats.ImageFormat:
    """As in flight, and PNG, which a bag may well hold. Raises RecordingError for what is not the camera's."""
    if image.size is None and "png" in image.encoding and "compressedDepth" not in image.encoding:
        return _PngFormat(size)
    try:
        return ros_format(image.encoding, image.size, image.bytes_per_line, size, words)
    except ValueError as error:
        raise RecordingError(f"{message.topic}: {error}") from None


@dataclass(frozen=True)
class _PngFormat:
    """PNG images of a camera's size; whether one is whole shows when it is decoded."""

    size: tuple[int, int]

    def check(self, data: bytes) -> None:
        """See ``ImageFormat``; nothing is checked before decoding."""

    def pixels(self, data: bytes) -> UInt8Array:
        """See ``ImageFormat``."""
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
        except cv2.error:
            image = None
        if image is None or image.shape[1::-1] != self.size:
            shown = "no PNG" if image is None else f"a PNG of {image.shape[1]}x{image.shape[0]}"
            raise CorruptImageError(f"{shown} instead of {self.size[0]}x{self.size[1]}")
        return np.asarray(image, np.uint8)


def _states(bag: Bag, topic: str, config: DroneConfig, began_ns: int, tell: Callable[[str], None]) -> NearestState:
    """All states of the vehicle in the bag."""
    check_height(f"{bag.path}: {topic}", bag.kinds()[topic], config)
    states, on_arrival, count, unusable, usable = NearestState(kept=None), False, 0, 0, list[VehicleState]()
    for message in bag.messages([topic]):
        content = bag.read(message)
        stamp, own_clock = state_stamp_ns(message.kind, content, message.time_ns)
        on_arrival |= own_clock
        state = vehicle_state(message.kind, content, _time_s(stamp, began_ns))
        states.add(state)
        usable += [state] if state is not None else []
        count, unusable = count + 1, unusable + (state is None)
    if unusable:
        told = f"{bag.path}: {unusable} of {count} states of {topic} have no attitude or place in ENU and FLU"
        if unusable == count:
            raise RecordingError(f"{told}; name another topic with --vehicle")
        tell(told)
    if (fault := _contradiction(usable, config)) is not None:
        raise RecordingError(f"{bag.path}: {topic} {fault}")
    if on_arrival:
        tell(
            f"{bag.path}: stamps of {topic} are of the autopilot's own clock; the times at which it was recorded count"
        )
    return states


def _contradiction(states: Sequence[VehicleState], config: DroneConfig) -> str | None:
    """Why odometry cannot be in metres, with z up, and with velocities of the body; None: it can."""
    if config.perception.scale == "height" and states and max(one.height_m for one in states) <= 0.0:
        told = "is never above 0 m, and perception.scale is `height`"
        return f"{told}; give heights with z up, or set perception.scale to `network`"
    if states and np.median([one.R_ned_body[2, 2] for one in states]) < _UPRIGHT:
        return "has the drone on its side, or upside down; give attitudes in the order x, y, z, w"
    known = ((one.time_s, one.position, one.velocity_ned) for one in states)
    both = [(time_s, place, v[:2]) for time_s, place, v in known if place is not None and v is not None]
    if not both:
        return None
    times_s, places, velocities = (np.array(part, np.float64) for part in zip(*both, strict=True))
    ways = cumulative_trapezoid(velocities, times_s, axis=0, initial=0)
    last = np.searchsorted(times_s, times_s + _APART_S)
    inside = np.append(times_s, np.inf)[last] < times_s + 2 * _APART_S  # of the recording, and without a longer gap
    first = np.flatnonzero(inside)
    last = last[first]
    moved, said = ((of[last] - of[first]) / (times_s[last] - times_s[first])[:, None] for of in (places, ways))
    off = np.linalg.norm(moved - said, axis=1) - 0.5 * np.linalg.norm([moved, said], axis=2).max(axis=0)
    if not len(first) or np.median(off) <= _OFF_M_S:
        return None
    speeds = (float(np.median(np.linalg.norm(of, axis=1))) for of in (said, moved))
    return (
        "says {:.1f} m/s, and its positions move by {:.1f} m/s, or another way; give metres, velocities of the body "
        "(FLU), and attitudes in the order x, y, z, w".format(*speeds)
    )


_APART_S, _UPRIGHT = 0.5, 0.5
"""Time between positions; and the cosine of the lean beyond which half a flight is not flown."""
_OFF_M_S = 0.5
"""Odometry may err by that, or by half its speed, before it contradicts itself."""


def _vehicle_topic(bag: Bag, wanted: str | None) -> str:
    """The topic that is named, or the only one of the best kind in the bag. Raises UsageError."""
    kinds = bag.kinds()
    if wanted is not None:
        if kinds.get(wanted) not in STATES:
            raise UsageError(
                f"{bag.path}: {wanted} is {kinds.get(wanted, 'not in it')}; name one of {', '.join(STATES)}"
            )
        return wanted
    for kind in STATES:
        topics = sorted(topic for topic, its in kinds.items() if its == kind)
        if len(topics) == 1:
            return topics[0]
        if topics:
            raise UsageError(f"{bag.path}: has several topics of {kind}; name one with --vehicle: {', '.join(topics)}")
    raise UsageError(f"{bag.path}: has no odometry, pose or IMU, from which the drone's attitude is known")


def _entries(step: int, frames: RawFrameSet, vehicle: VehicleState, lost: Counter[str]) -> Iterator[Entry]:
    """Images that do not decode are left out, as a drone does, and counted by the reason; those that came as JPEG stay
    so, others become PNG."""
    kept = []
    for camera, frame in frames.frames.items():
        try:
            image = frame.decode(frame.data)
        except CorruptImageError as error:
            lost[f"camera {camera}: {error}"] += 1
            continue
        data, stamp = frame.data, nanoseconds(frame.time_s)
        form: ImageFormat = "jpeg"
        if not isinstance(getattr(frame.decode, "__self__", None), MjpegFormat):
            data, form = bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]), "png"
        kept.append(FrameEntry(camera, frame.time_s, frame.sequence))
        yield Entry(foxglove.image_stream(camera), stamp, step, foxglove.image(stamp, camera, data, form))
    stamp = nanoseconds(frames.time_s)
    for stream, message in ((FRAMES, StepFrames(step, frames.time_s, tuple(kept))), (VEHICLE, vehicle)):
        yield Entry(stream, stamp, step, json.dumps(to_json(message), allow_nan=False).encode())


METADATA = "metadata.yaml"


def is_bag(path: Path) -> bool:
    """Whether a path is the folder of a bag."""
    return (path / METADATA).is_file()


class BagMessage(NamedTuple):
    """One message of a bag."""

    topic: str
    kind: str
    time_ns: int
    data: bytes
    """As it travels (CDR)."""


class Bag:
    """A bag, open for reading. Raises RecordingError for an unreadable one, ModuleNotFoundError without `rosbags`."""

    def __init__(self, folder: Path) -> None:
        from rosbags.rosbag2 import Reader, ReaderError  # noqa: PLC0415 - of an extra
        from rosbags.typesys import TypesysError, get_types_from_msg  # noqa: PLC0415 - of an extra

        self.path = folder
        self._store = _store()
        try:
            self._reader = Reader(folder)
            self._reader.open()
            for one in self._reader.connections:  # such as PX4's, as the bag defines them
                if one.msgtype not in self._store.fielddefs and one.msgdef.data:
                    self._store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
        except (ReaderError, TypesysError, OSError, ValueError, KeyError) as error:
            told = f"is not a readable bag ({error}); use another copy"
            if "metadata" in str(error):
                told = f"its metadata.yaml is not whole; write it again with `ros2 bag reindex {folder}`"
            if "magic" in str(error):
                told = "its MCAP file has no end, as of a recorder that was killed; `mcap recover` keeps what is whole"
            raise RecordingError(f"{folder}: {told}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def kinds(self) -> dict[str, str]:
        """The type of each topic."""
        return {one.topic: one.msgtype for one in self._reader.connections}

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """The messages of these topics in order of time. Raises RecordingError where the bag is damaged."""
        wanted = [one for one in self._reader.connections if one.topic in topics]
        if not wanted:
            return
        try:
            for connection, time_ns, data in self._reader.messages(wanted):
                yield BagMessage(connection.topic, connection.msgtype, time_ns, bytes(data))
        except RecordingError:
            raise
        except Exception as error:  # of whatever library unpacks it
            raise RecordingError(f"{self.path}: cannot be read to its end ({error}); use another copy") from error

    def read(self, message: BagMessage) -> Any:
        """The message with its fields as attributes. Raises RecordingError if it cannot be read."""
        try:
            return self._store.deserialize_cdr(message.data, message.kind)
        except Exception as error:  # of generated code: struct.error, UnicodeDecodeError and others
            raise RecordingError(f"{self.path}: a message of {message.topic} cannot be read ({error})") from error


def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - of an extra

    return get_typestore(Stores.ROS2_JAZZY)
