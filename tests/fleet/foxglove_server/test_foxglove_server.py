"""What a client of Foxglove's protocol gets from the real server, of drones that publish over zenoh."""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from scipy.spatial.transform import Rotation

from flockd.fleet.foxglove.server import FoxgloveServer
from flockd.fleet.page.live_fleet import LiveFleet
from flockd.fleet.page.recorded_fleet import RecordedFleet
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.recording.reader import Recording
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage
from flockd.sim.free_ports import free_endpoint
from tests.fleet.foxglove_server.websocket_client import FoxgloveClient
from tools.docs.foxglove_layout import LAYOUT, layout

FRONT = {"name": "front", "size_px": [640, 480], "intrinsics": {"fx": 300.0, "fy": 300.0, "cx": 320.0, "cy": 240.0}}
ABOUT = AboutMessage(
    version="1.2.3",
    configuration={"safety": {"gate": {"fence_radius_m": 40.0}}, "rig": {"cameras": [FRONT]}},
    commands=["hold", "land"],
)
STATE: dict[str, Any] = {
    "height_m": 5.0, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0, "velocity_ned": [0.0, 1.5, 0.5],
    "position_ne": [10.0, 20.0], "home_deg": [47.0, 8.0],
}  # fmt: skip
NEIGHBOUR = {
    "track": 7, "position_ned": [0.0, 8.0, 0.0], "velocity_ned": [0.0, 1.0, 0.0], "position_sigma_m": 0.4,
    "velocity_sigma_m_s": 0.1, "age_s": 3.0, "unseen_s": 0.0, "confirmed": True,
}  # fmt: skip
FLIGHT: dict[str, Any] = {
    "state": "degraded", "reasons": [{"event": "x", "sentence": "the battery is low; land"}],
    "flight_mode": "offboard", "armed": True, "in_air": True, "heartbeat_age_s": 0.1, "heartbeats_lost": 0,
    "battery_share": 0.4,
    "height_m": 5.0, "velocity_trim": [0.0, 0.0], "velocity_error_m_s": 0.1, "silence": None, "setpoints_sent": 9,
    "setpoints_missed": 2, "orders": [], "orders_refused": 0,
}  # fmt: skip
COMPUTER: dict[str, Any] = {
    "cameras": {"front": {"age_s": 0.1, "fault": None, "counts": {}}}, "load": 0.5, "steps": 9, "steps_failed": 0,
    "network_faults": 0, "networks_stuck": 0, "loop_lag_s": 0.0, "temperature_c": 50.0, "messages_lost": 0,
    "recording": None,
}  # fmt: skip
MISSION: dict[str, Any] = {
    "kind": "waypoints", "sentence": "flies to 1 of 2", "goal_ne": [30.0, 0.0], "goal_height_m": 6.0,
    "position_ne": [10.0, 20.0], "arrived": False,
}  # fmt: skip
RANGES = [4.0 if sector == 18 else None for sector in range(72)]
"""Something 4 m to the east."""
PLACE = [20.0, 10.0, 5.0]
"""East, north, up."""
PICTURE = bytes(cv2.imencode(".jpg", np.full((240, 320, 3), 90, np.uint8))[1])
"""A picture of half the camera's size."""
CAMERA = "/drone1/camera/front"
FLOWN = Path(__file__).parents[2] / "review" / "replay" / "crossing.mcap"


@contextmanager
def publishing(drone: ZenohTelemetry) -> Iterator[list[str]]:
    """drone1, until the end; gives what is asked of it."""
    asked: list[str] = []
    over = threading.Event()

    def ask(command: str, payload: bytes) -> AnswerMessage:
        asked.append(command)
        return AnswerMessage(accepted=True, sentence="")

    def publish() -> None:
        for number in itertools.count():
            stamp = {"time_s": 0.25 * number}
            drone.publish("drone1", "state", {**STATE, **stamp})
            drone.publish("drone1", "neighbours", {"neighbours": [NEIGHBOUR], **stamp})
            drone.publish("drone1", "obstacles", {"range_m": RANGES, "seen_m": [10.0] * 72, **stamp})
            drone.publish("drone1", "flight", {**FLIGHT, **stamp})
            drone.publish("drone1", "computer", {**COMPUTER, **stamp})
            drone.publish("drone1", "mission", {**MISSION, **stamp})
            if over.wait(0.25):
                return

    drone.announce("drone1", ABOUT, ask, lambda camera: PICTURE if camera == "front" else None)
    drone.publish("drone1", "events", {"time_s": 0.0, "event": "the pilot selected offboard"})
    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield asked
    finally:
        over.set()
        thread.join()


@pytest.fixture(scope="module")
def app() -> Iterator[tuple[FoxgloveClient, list[str]]]:
    """A client that got everything once, then tried to command; and what was asked of the drone."""
    endpoint = free_endpoint()

    async def connected(port: int) -> FoxgloveClient:
        async with FoxgloveClient(port) as client:
            await client.until(lambda got: len(got.messages) == len(got.channels) > 15)
            await client.until(lambda got: got.json("/fleet")["drones"][0]["version"] == "1.2.3")
            await client.until(lambda got: got.decoded("/scene/fences", SceneUpdate).entities[0].lines)
            await client.until(lambda got: f"{CAMERA}/calibration" in got.messages)
            await client.until(lambda got: got.decoded(f"{CAMERA}/tracks", ImageAnnotations).circles)
            channel = {"id": 1, "topic": "/drone1/ask/land", "encoding": "json", "schemaName": ""}
            await client.socket.send_json({"op": "advertise", "channels": [channel]})
            await client.socket.send_bytes(b"\x01\x01\x00\x00\x00{}")
            await client.until(lambda got: got.statuses)
        return client

    with (
        FleetWatcher(None, listen=[endpoint], connect=[]) as watcher,
        LiveFleet(watcher) as source,
        ZenohTelemetry("meadow", listen=[], connect=[endpoint]) as drone,
        publishing(drone) as asked,
        FoxgloveServer(source, "127.0.0.1", 0) as server,
    ):
        yield asyncio.run(connected(server.port)), asked


App = tuple[FoxgloveClient, list[str]]


def test_nothing_can_be_sent_through_it(app: App) -> None:
    client, asked = app
    assert client.server["capabilities"] == [], "neither publishing, parameters nor services"
    assert client.statuses[0]["level"] > 0, "a warning or an error"
    assert asked == []


def test_each_topic_of_telemetry_is_passed_on_as_it_was_published(app: App) -> None:
    client, _ = app
    for topic, published in (("state", STATE), ("flight", FLIGHT), ("computer", COMPUTER), ("mission", MISSION)):
        channel = client.channels[f"/drone1/{topic}"]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
        message = client.json(f"/drone1/{topic}")
        assert message.keys() == json.loads(channel["schema"])["properties"].keys()
        assert message.pop("time_s") % 0.25 == 0
        assert message == published
    assert client.json("/drone1/neighbours")["neighbours"] == [NEIGHBOUR]


def test_the_fleet_has_a_row_a_drone(app: App) -> None:
    (row,) = app[0].json("/fleet")["drones"]
    known: dict[str, Any] = {
        "drone": "drone1",
        "fleet": "meadow",
        "state": "degraded",
        "why": "the battery is low; land",
    }
    known |= {"north_m": 10.0, "east_m": 20.0, "speed_m_s": 1.5, "battery_share": 0.4, "neighbours": 1, "load": 0.5}
    assert {name: row[name] for name in known} == known


def test_a_drone_is_where_it_says_and_faces_where_it_says(app: App) -> None:
    transforms = {one.child_frame_id: one for one in app[0].decoded("/tf", FrameTransforms).transforms}
    body = transforms["drone1"]
    assert (body.parent_frame_id, [body.translation.x, body.translation.y, body.translation.z]) == ("map", PLACE)
    turn = Rotation.from_quat([body.rotation.x, body.rotation.y, body.rotation.z, body.rotation.w])
    assert turn.apply([1, 0, 0]) == pytest.approx([1, 0, 0], abs=1e-9), "its nose points east"
    assert turn.apply([0, 0, 1]) == pytest.approx([0, 0, -1], abs=1e-9)
    camera = transforms["drone1/camera/front"]
    optical = Rotation.from_quat([camera.rotation.x, camera.rotation.y, camera.rotation.z, camera.rotation.w])
    assert camera.parent_frame_id == "drone1"
    assert (turn * optical).apply([0, 0, 1]) == pytest.approx([1, 0, 0], abs=1e-9), "and its front camera too"
    fix = app[0].decoded("/drone1/fix", LocationFix)
    metres = 6_371_000 * math.pi / 180
    assert fix.latitude - 47.0 == pytest.approx(10.0 / metres, rel=0.01)
    assert fix.longitude - 8.0 == pytest.approx(20.0 / (metres * math.cos(math.radians(47.0))), rel=0.01)


def test_the_scene_has_course_neighbours_obstacles_goal_and_fence(app: App) -> None:
    def entity(topic: str) -> Any:
        (found,) = app[0].decoded(topic, SceneUpdate).entities
        assert found.id == "drone1"
        return found

    assert entity("/scene/drones").frame_id == "drone1"
    assert "degraded" in entity("/scene/drones").texts[0].text
    course = entity("/scene/courses")
    assert xyz(course.lines[0].points[1]) == pytest.approx([20.0 + 2 * 1.5, 10.0, 5.0 - 2 * 0.5]), "in two seconds"
    assert xyz(course.spheres[0].pose.position) == [0.0, 30.0, 6.0]
    (neighbour,) = entity("/scene/neighbours").spheres
    assert xyz(neighbour.pose.position) == [28.0, 10.0, 5.0]
    assert neighbour.size.x == pytest.approx(0.8), "one standard deviation to each side"
    start, end = map(xyz, entity("/scene/obstacles").lines[0].points)
    assert np.hypot(*(np.array(start) - PLACE)[:2]) == pytest.approx(4.0)
    assert np.add(start, end) / 2 == pytest.approx([24.0, 10.0, 5.0], abs=0.01)
    (fence,) = entity("/scene/fences").lines
    assert [np.hypot(point.x, point.y) for point in fence.points] == pytest.approx([40.0] * len(fence.points))


def test_pictures_come_with_their_calibration_and_the_tracked_drones(app: App) -> None:
    client = app[0]
    image = client.decoded(f"{CAMERA}/image", CompressedImage)
    assert (image.data, image.format, image.frame_id) == (PICTURE, "jpeg", "drone1/camera/front")
    calibration = client.decoded(f"{CAMERA}/calibration", CameraCalibration)
    assert (calibration.width, calibration.height, calibration.K[0]) == (320, 240, 150.0)
    tracks = client.decoded(f"{CAMERA}/tracks", ImageAnnotations)
    (circle,), (text,) = tracks.circles, tracks.texts
    assert [circle.position.x, circle.position.y] == pytest.approx([159.5, 119.5]), "straight ahead"
    assert text.text == "track 7: 8.0 m"


def test_events_and_what_is_the_matter_are_in_the_log(app: App) -> None:
    told = []
    for _, data in app[0].messages["/log"]:
        entry = Log()
        entry.ParseFromString(data)
        told.append((entry.level, entry.name, entry.message))
    assert (Log.Level.Value("INFO"), "drone1", "the pilot selected offboard") in told
    assert told[-1] == (Log.Level.Value("WARNING"), "drone1", "degraded: the battery is low; land")


def test_the_layout_shows_topics_that_there_are(app: App) -> None:
    written = json.loads(LAYOUT.read_text(encoding="utf-8"))
    assert written == layout(), "run python -m tools.docs.foxglove_layout"
    paths = {text for text in texts(written) if text.startswith("/")}
    assert {path.partition(".")[0] for path in paths} <= app[0].channels.keys()
    assert {"/fleet.drones", "/log", f"{CAMERA}/image", "/scene/drones"} <= paths
    fields = json.loads(app[0].channels["/fleet"]["schema"])["properties"]["drones"]["items"]["properties"]
    plotted = {path.rpartition("}.")[2] for path in paths if "}." in path}
    assert plotted
    assert {fields[name]["type"] for name in plotted} <= {"number", "integer"}
    panels = {panel["panelType"] for panel in objects(written) if "panelType" in panel}
    assert panels == {"ThreeDee", "Plot", "Image", "Table", "Log"}


def test_the_schemas_are_of_the_kind_that_the_app_reads(app: App) -> None:
    """One type a field; objects tell their properties, lists their items."""
    for channel in app[0].channels.values():
        if channel["encoding"] != "json":
            continue
        for node in objects(json.loads(channel["schema"])):
            if isinstance(node.get("type"), str):
                assert node["type"] in {"object", "array", "number", "integer", "boolean", "string"}
                assert (node["type"] != "object" or "properties" in node) and (
                    node["type"] != "array" or "items" in node
                )


@pytest.mark.slow
def test_recordings_are_played_and_the_app_goes_where_it_wants(tmp_path: Path) -> None:
    shutil.copy(FLOWN, tmp_path)
    source, drone = RecordedFleet(tmp_path), Recording(FLOWN).drone
    begin_s, end_s = source.span_s

    async def watch(port: int) -> tuple[dict[str, Any], dict[str, Any]]:
        async with FoxgloveClient(port) as client:
            await client.until(lambda got: f"/{drone}/state" in got.messages and got.server)
            first = client.json(f"/{drone}/state")
            await client.go_to(round(1e9 * source.wall_s(end_s)), play=False)
            await client.until(lambda got: got.json(f"/{drone}/state")["time_s"] == end_s)
            await client.until(lambda got: any(b"request" in data for data in got.other))
            return first, client.server

    with FoxgloveServer(source, "127.0.0.1", 0) as server:
        first, told = asyncio.run(watch(server.port))
    assert first["time_s"] < begin_s + 2.0, "it starts when somebody watches"
    assert set(told["capabilities"]) == {"time", "playbackControl"}


def xyz(place: Any) -> list[float]:
    return [place.x, place.y, place.z]


def objects(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict):
        yield node
    for inner in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from objects(inner)


def texts(node: Any) -> Iterator[str]:
    """Keys and values."""
    if isinstance(node, str):
        yield node
    elif isinstance(node, dict | list):
        for inner in (*node, *node.values()) if isinstance(node, dict) else node:
            yield from texts(inner)
