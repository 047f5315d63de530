"""A recording as a bag of ROS 2, and back: standard messages for everybody, and flockd's own beside them, exact.

What standard messages hold goes into them, with stamps on the recording's clock to the nanosecond. What they cannot
hold, the configuration and the exact numbers of each step, goes into `/DRONE/flockd/...` as text (JSON), so that the
bag is a whole recording: `Recording` opens it like a file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.messages import Matrix3, PilotOutput, VehicleState
from flockd.core.ros_frames import attitude_in_ros, camera_in_ros, enu_of_ned, flu_of_frd
from flockd.flight.geometry import build_rig
from flockd.onboard.recording import foxglove
from flockd.onboard.recording.codec import from_json, parsed
from flockd.onboard.recording.mcap_file import Entry, Inclosure, Note, Record, RecordingError, read_records
from flockd.onboard.recording.ros_bag import Bag, BagWriter, Storage
from flockd.onboard.recording.streams import (
    CONFIGURATION,
    END_NOTE,
    FLIGHT_NOTE,
    FRAMES,
    MODELS_NOTE,
    ORDER,
    OUTPUT,
    TABLE,
    TRUTH,
    VEHICLE,
    is_image,
)
from flockd.onboard.recording.truth import Truth
from flockd.onboard.ros import message_trees as trees
from flockd.onboard.ros.message_trees import Names, Tree, ros_name
from flockd.onboard.telemetry.step_messages import neighbour_message

_OWN = "flockd"
"""Below the drone's namespace: what only flockd reads."""
_STREAMS = {stream.topic: stream for stream in (FRAMES, VEHICLE, ORDER, OUTPUT, TRUTH, *TABLE.values())}
_NOTES = (FLIGHT_NOTE, MODELS_NOTE, END_NOTE)
_IMAGE = "image/compressed"


def export_bag(paths: tuple[Path, ...], drone: str, config: DroneConfig, folder: Path, storage: Storage) -> int:
    """Writes a recording's files as one bag; gives the number of messages. Raises RecordingError and OSError."""
    count = 0
    with BagWriter(folder, storage) as bag:
        for topic, kind, time_ns, tree in _messages(paths, Names(ros_name(drone)), config):
            bag.write(topic, kind, time_ns, tree)
            count += 1
    return count


def is_own(bag: Bag) -> bool:
    """Whether `export_bag` wrote it."""
    return _space(bag) is not None


def bag_records(folder: Path) -> Iterator[Record]:
    """The records of the recording that a bag was made of, but for those that are for viewers alone.

    Raises RecordingError for a bag that flockd did not write.
    """
    with Bag(folder) as bag:
        space = _space(bag)
        if space is None:
            raise RecordingError(
                f"{folder}: is a bag, but none of flockd; `flockd replay` flies its images with a drone's --config"
            )
        own = f"{space}/{_OWN}/"
        heads = {f"{own}{name}" for name in (*_NOTES, "configuration")}
        ends: list[Note] = []
        for message in bag.messages(heads):
            name, text = message.topic.removeprefix(own), bag.read(message).data
            if name == "configuration":
                yield Inclosure(CONFIGURATION, "application/json", text.encode())
            elif name == END_NOTE:
                ends.append(Note(name, _object(folder, text)))
            else:
                yield Note(name, _object(folder, text))
        yield from _entries(bag, space, own)
        yield from ends


def _entries(bag: Bag, space: str, own: str) -> Iterator[Entry]:
    """Messages of steps with the numbers of those, which images do not carry: they have their step's time."""
    frames = f"{own}{FRAMES.topic.strip('/')}"
    numbers = {one.time_ns: _object(bag.path, bag.read(one).data)["sequence"] for one in bag.messages([frames])}
    images = {topic for topic in bag.kinds() if topic.startswith(f"{space}/camera/") and topic.endswith(_IMAGE)}
    streams = {f"{own}{topic.strip('/')}": stream for topic, stream in _STREAMS.items()}
    for message in bag.messages({*images, *streams}):
        content = bag.read(message)
        if message.topic in images:
            camera = content.header.frame_id.partition("/")[2].removesuffix("_optical")
            stamp_ns = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
            data = foxglove.image(stamp_ns, camera, content.data.tobytes(), content.format)
            yield Entry(foxglove.image_stream(camera), stamp_ns, numbers.get(message.time_ns, -1), data)
        else:
            wrapped = _object(bag.path, content.data)
            stream = streams[message.topic]
            yield Entry(stream, wrapped["time_ns"], wrapped["sequence"], json.dumps(wrapped["message"]).encode())


def _space(bag: Bag) -> str | None:
    """The namespace of the drone whose recording it was; None for a bag of somebody else's."""
    end = f"/{_OWN}/{FLIGHT_NOTE}"
    return next((topic.removesuffix(end) for topic in bag.kinds() if topic.endswith(end)), None)


def _object(path: Path, text: str) -> Any:
    try:
        return parsed(text.encode())
    except ValueError as error:
        raise RecordingError(
            f"{path}: a message of flockd's in it cannot be read ({error}); use another copy"
        ) from error


def _messages(paths: tuple[Path, ...], names: Names, config: DroneConfig) -> Iterator[tuple[str, str, int, Tree]]:
    """Topic, type, time and message of all that the bag gets."""
    space, began_ns = f"/{names.drone}", _first_ns(paths)
    own, written, end = f"{space}/{_OWN}", set[str](), Note(END_NOTE, {})
    images: list[Entry] = []
    for record in (record for path in paths for record in read_records(path)):
        match record:
            case Note(name) if name == END_NOTE:
                end = record
            case Note(name, facts) if name in _NOTES and name not in written:
                written.add(name)
                yield f"{own}/{name}", trees.TEXT, began_ns, {"data": json.dumps(dict(facts))}
            case Inclosure(name, _, data) if name == CONFIGURATION and name not in written:
                written.add(name)
                yield f"{own}/configuration", trees.TEXT, began_ns, {"data": data.decode()}
                yield from _cameras(space, names, config, began_ns)
            case Entry(stream) if is_image(stream.topic):
                images.append(record)
            case Entry(stream, time_ns, sequence, data) if stream.topic in _STREAMS:
                if stream.topic == FRAMES.topic:
                    yield from (_image(space, names, image, time_ns) for image in images)
                    images = []
                message = parsed(data)
                wrapped = {"sequence": sequence, "time_ns": time_ns, "message": message}
                yield f"{own}/{stream.topic.strip('/')}", trees.TEXT, time_ns, {"data": json.dumps(wrapped)}
                yield from _standard(space, names, stream.topic, time_ns, message)
            case _:
                continue
    yield f"{own}/{END_NOTE}", trees.TEXT, began_ns, {"data": json.dumps(dict(end.facts))}


def _image(space: str, names: Names, entry: Entry, step_ns: int) -> tuple[str, str, int, Tree]:
    """An image of a step, at whose time it stands in the bag; its stamp is its own."""
    camera = entry.stream.topic.split("/")[-2]
    data, form = foxglove.image_data(entry.data)
    tree = trees.compressed_image(entry.time_ns, names.optical(camera), data, form)
    return f"{space}/camera/{ros_name(camera)}/{_IMAGE}", trees.COMPRESSED_IMAGE, step_ns, tree


def _first_ns(paths: tuple[Path, ...]) -> int:
    """Time of the first message: that of what has no time of its own."""
    return next((one.time_ns for path in paths for one in read_records(path) if isinstance(one, Entry)), 0)


def _cameras(space: str, names: Names, config: DroneConfig, time_ns: int) -> Iterator[tuple[str, str, int, Tree]]:
    """Lenses and places of the cameras, once."""
    places = []
    for camera, mounted in zip(config.rig.cameras, build_rig(config.rig).cameras.values(), strict=True):
        frame = names.optical(camera.name)
        info = trees.camera_info(time_ns, frame, camera, camera.size_px)
        yield f"{space}/camera/{ros_name(camera.name)}/camera_info", trees.CAMERA_INFO, time_ns, info
        place = mounted.T_body_camera
        places.append(
            trees.transform(
                time_ns, names.base_link, frame, flu_of_frd(place.translation), camera_in_ros(place.rotation)
            )
        )
    yield "/tf_static", trees.TRANSFORMS, time_ns, {"transforms": places}


def _standard(
    space: str, names: Names, topic: str, time_ns: int, message: Mapping[str, Any]
) -> Iterator[tuple[str, str, int, Tree]]:
    """What of a message standard ones can hold."""
    if topic == VEHICLE.topic:
        vehicle: VehicleState = from_json(VehicleState, message)
        if not _is_rotation(vehicle.R_ned_body):
            return
        yield f"{space}/imu", trees.IMU, time_ns, trees.imu(time_ns, names, vehicle.R_ned_body)
        if vehicle.position is not None:
            place = np.array([*vehicle.position, -vehicle.height_m])
            tree = trees.odometry(time_ns, names, place, vehicle.R_ned_body, vehicle.velocity_ned)
            yield f"{space}/odometry", trees.ODOMETRY, time_ns, tree
            yield "/tf", trees.TRANSFORMS, time_ns, _place(time_ns, names, place, vehicle.R_ned_body)
    elif topic == OUTPUT.topic:
        output: PilotOutput = from_json(PilotOutput, message)
        seen = [neighbour_message(one) for one in output.neighbours]
        yield f"{space}/neighbours", trees.POSE_ARRAY, time_ns, trees.neighbour_poses(time_ns, names, seen)
        yield f"{space}/neighbours/tracks", trees.POINT_CLOUD, time_ns, trees.tracks(time_ns, names, seen)
        wanted = np.array([*output.command.velocity, 0.0])
        yield f"{space}/command", trees.TWIST, time_ns, trees.twist(time_ns, names.level, wanted)
    elif topic == TRUTH.topic:
        truth: Truth = from_json(Truth, message)
        for one in truth.drones:
            other = Names(ros_name(one.name))
            tree = trees.odometry(time_ns, other, one.position, one.R_ned_body, one.velocity)
            tree["header"]["frame_id"] = "world"
            yield f"{space}/truth/{other.drone}", trees.ODOMETRY, time_ns, tree


def _is_rotation(R: Matrix3) -> bool:
    """A recording may hold an attitude that is none: its flight refused it, and a quaternion cannot hold it."""
    return bool(np.isfinite(R).all()) and float(np.linalg.det(R)) > 0


def _place(time_ns: int, names: Names, place_ned: Any, R_ned_body: Matrix3) -> Tree:
    place, R = enu_of_ned(place_ned), attitude_in_ros(R_ned_body)
    return {
        "transforms": [
            trees.transform(time_ns, names.odom, names.level, place, np.eye(3)),
            trees.transform(time_ns, names.odom, names.base_link, place, R),
        ]
    }
