"""Publishes the fleet, update by update, to whoever has subscribed."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import foxglove.channels as fc
import foxglove.messages as fm
import numpy as np
from foxglove import Channel, Context

from flockd.core.image_header import jpeg_size
from flockd.core.messages import FloatArray
from flockd.fleet.camera_rigs import cameras_of
from flockd.fleet.fleet_status import GONE
from flockd.fleet.foxglove.drone_cameras import calibration, camera_transforms, frame_of, image, tracks
from flockd.fleet.foxglove.fleet_scene import (
    COLOURS,
    SCENE_TOPICS,
    SceneDrone,
    body_transform,
    empty_scene,
    enu,
    location_fix,
    place_of,
    scene_update,
)
from flockd.fleet.foxglove.json_rows import fleet_row, fleet_schema, json_schema
from flockd.fleet.page.drone_rows import Known, Row
from flockd.fleet.page.fleet_source import Event, FleetSource, events_after
from flockd.onboard.telemetry.topics import TOPICS

FLEET, LOG, TRANSFORMS = "/fleet", "/log", "/tf"
PATH_S = 60.0
EVERY_S = 1.0
"""A camera's picture is asked for no oftener."""
_THREADS = 8
"""That wait for pictures."""
_CALIBRATION = partial(Channel, schema=fm.CameraCalibration.get_schema(), message_encoding="protobuf")


class _CameraChannels(NamedTuple):
    image: Any
    tracks: Any
    calibration: Any


class FleetPublisher:
    """`update` publishes what is new. All on one thread, but for the pictures, which wait on threads of their own."""

    def __init__(self, source: FleetSource, context: Context) -> None:
        """``source``: stays its owner's."""
        self._source, self._context = source, context
        self._channels: dict[str, Any] = {}
        self._names: dict[str, str] = {}
        self._threads = ThreadPoolExecutor(_THREADS, "pictures for Foxglove")
        self._forget()

    def close(self) -> None:
        """Waits for nothing but a picture that is on its way."""
        self._threads.shutdown(cancel_futures=True)

    def update(self, time_s: float, *, jumped: bool = False) -> None:
        """Publishes the fleet as it is at a time of its time line. Raises what a picture's thread met.

        ``jumped``: the time line went elsewhere since the last update, of which nothing holds any longer.
        """
        if jumped:
            self._forget()
            for topic in SCENE_TOPICS:
                self._channel(topic, fc.SceneUpdateChannel).log(empty_scene(), log_time=self._ns(time_s))
        rows = self._source.rows(time_s)
        watched = [drone for drone in self._source.drones(time_s) if f"{drone.fleet}/{drone.drone}" in rows]
        if self._source.span_s is None:
            self._close_channels(rows)
        for key in sorted(rows):  # its own name, with its fleet where another fleet has one of this name
            short = key.partition("/")[2]
            self._names.setdefault(key, key if short in self._names.values() else short)
        self._publish_log(rows, time_s)
        ordered = sorted(rows, key=lambda key: (len(self._names[key]), self._names[key]))  # drone2 before drone10
        fleet = {"drones": [fleet_row(self._names[key], rows[key]) for key in ordered]}
        self._channel(FLEET, partial(Channel, schema=fleet_schema())).log(fleet, log_time=self._ns(time_s))
        for drone in watched:
            for topic in (topic for topic in drone.topics if topic != "events"):  # those are in the log
                message = drone.message(topic, time_s)
                if message is not None:
                    self._publish_message(f"{drone.fleet}/{drone.drone}", topic, drone.topics[topic].time_s, message)
        self._publish_scene({key: rows[key] for key in ordered}, time_s)
        for key, row in rows.items():
            for camera in row["cameras"]:
                self._ask_for_picture(key, row, camera, time_s)

    def _forget(self) -> None:
        self._sent: dict[str, float] = {}
        self._told: dict[str, str] = {}
        self._event: Event | None = None
        self._places: dict[str, FloatArray] = {}
        self._asked: dict[str, tuple[float, Future[None]]] = {}

    def _channel(self, topic: str, kind: Any) -> Any:
        if topic not in self._channels:
            self._channels[topic] = kind(topic, context=self._context)
        return self._channels[topic]

    def _close_channels(self, rows: Mapping[str, Row]) -> None:
        """Of drones that are forgotten: names that somebody invents leave nothing."""
        for key in self._names.keys() - rows.keys():
            beginning = f"/{self._names.pop(key)}/"
            self._places.pop(key, None)
            self._told.pop(key, None)
            for frame in [frame for frame in self._asked if f"/{frame}/".startswith(beginning)]:
                del self._asked[frame]
            for topic in [topic for topic in self._channels if topic.startswith(beginning)]:
                self._channels.pop(topic).close()
                self._sent.pop(topic, None)

    def _publish_message(self, key: str, topic: str, heard_s: float, message: Mapping[str, Any]) -> None:
        """A message of telemetry that is new to whoever subscribed."""
        name = f"/{self._names[key]}/{topic}"
        channel = self._channel(name, partial(Channel, schema=json_schema(TOPICS[topic].type)))
        if channel.has_sinks() and self._sent.get(name) != heard_s:
            self._sent[name] = heard_s
            channel.log({**message}, log_time=self._ns(heard_s))

    def _publish_log(self, rows: Mapping[str, Row], time_s: float) -> None:
        """Events, and why a drone is not well when that changes; all that is remembered to whoever comes first."""
        if not self._channel(LOG, fc.LogChannel).has_sinks():
            return
        for event in events_after(self._source.events(time_s), self._event):
            self._tell(event[0], fm.LogLevel.Info, event[1], event[2])
            self._event = event
        for key, row in rows.items():
            told = ": ".join([row["state"], *filter(None, ["; ".join(row["why"])])])
            if self._told.get(key) != told:
                self._told[key] = told
                level = fm.LogLevel.Warning if row["why"] else fm.LogLevel.Info
                self._tell(time_s, fm.LogLevel.Error if row["state"] == GONE else level, key, told)

    def _tell(self, time_s: float, level: fm.LogLevel, key: str, sentence: str) -> None:
        name = self._names.get(key, key)  # by its key where it is forgotten
        entry = fm.Log(timestamp=self._stamp(time_s), level=level, message=sentence, name=name)
        self._channel(LOG, fc.LogChannel).log(entry, log_time=self._ns(time_s))

    def _publish_scene(self, rows: Mapping[str, Row], time_s: float) -> None:
        """Places, transforms and all that is drawn; ``rows`` in order of their names."""
        stamp, now_ns, history = self._stamp(time_s), self._ns(time_s), self._source.history()
        known, numbers = self._source.known(), list(self._names)
        self._places |= {key: place for key, row in rows.items() if (place := place_of(row)) is not None}
        # Without any position the first drone is in the middle, as on the page.
        places = self._places or {key: np.array([0.0, 0.0, rows[key]["height_m"] or 0.0]) for key in list(rows)[:1]}
        drones, transforms = [], []
        for key, row in ((key, row) for key, row in rows.items() if key in places):
            name, colour = self._names[key], COLOURS[numbers.index(key) % len(COLOURS)]
            path = [
                enu((north, east, -(height or 0.0)))
                for at_s, north, east, height, *_ in history.get(key, ())
                if north is not None and east is not None and time_s - PATH_S < (at_s or 0.0) <= time_s
            ]
            drones.append(SceneDrone(name, row, places[key], path, colour))
            cameras = cameras_of(known.get(key, Known()).about)
            transforms.append(body_transform(stamp, drones[-1]))
            transforms += camera_transforms(stamp, name, (camera.mounted for camera in cameras.values()))
            if (fix := location_fix(stamp, name, row)) is not None:
                self._channel(f"/{name}/fix", fc.LocationFixChannel).log(fix, log_time=now_ns)
        self._channel(TRANSFORMS, fc.FrameTransformsChannel).log(
            fm.FrameTransforms(transforms=transforms), log_time=now_ns
        )
        for topic in SCENE_TOPICS:
            channel = self._channel(topic, fc.SceneUpdateChannel)
            if channel.has_sinks():
                channel.log(scene_update(topic, drones, stamp), log_time=now_ns)

    def _ask_for_picture(self, key: str, row: Row, camera: str, time_s: float) -> None:
        """Once a second while somebody has subscribed to the camera, whose three channels are made here."""
        frame = frame_of(self._names[key], camera)
        channels = _CameraChannels(
            self._channel(f"/{frame}/image", fc.CompressedImageChannel),
            self._channel(f"/{frame}/tracks", fc.ImageAnnotationsChannel),
            self._channel(f"/{frame}/calibration", _CALIBRATION),
        )
        at_s, asked = self._asked.get(frame, (-EVERY_S, None))
        if asked is not None and asked.done():
            asked.result()  # raises what it met
        if channels.image.has_sinks() and abs(time_s - at_s) >= EVERY_S and (asked is None or asked.done()):
            job = self._threads.submit(self._publish_picture, key, row, camera, time_s, frame, channels)
            self._asked[frame] = time_s, job

    def _publish_picture(
        self, key: str, row: Row, name: str, time_s: float, frame: str, channels: _CameraChannels
    ) -> None:
        """On a thread of its own: the drone may take seconds to answer."""
        picture = self._source.image(key, name, time_s)
        if picture is None:
            return
        stamp, now_ns = self._stamp(time_s), self._ns(time_s)
        size_px, camera = jpeg_size(picture), cameras_of(self._source.known().get(key, Known()).about).get(name)
        if size_px is not None and camera is not None:
            channels.calibration.log(calibration(now_ns, frame, camera.config, size_px), log_time=now_ns)
            channels.tracks.log(tracks(stamp, camera, size_px, row), log_time=now_ns)
        channels.image.log(image(stamp, frame, picture), log_time=now_ns)

    def _ns(self, time_s: float) -> int:
        return round(1e9 * self._source.wall_s(time_s))

    def _stamp(self, time_s: float) -> fm.Timestamp:
        return fm.Timestamp.from_epoch_secs(self._source.wall_s(time_s))
