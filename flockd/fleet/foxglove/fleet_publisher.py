"""Publishes the fleet, update by update, to whoever has subscribed."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

from foxglove import Context
from foxglove.messages import FrameTransforms, Log, LogLevel, Timestamp

from flockd.fleet.fleet_status import GONE
from flockd.fleet.foxglove.camera_messages import Cameras, image
from flockd.fleet.foxglove.fleet_channels import JSON_TOPICS, FleetChannels
from flockd.fleet.foxglove.fleet_message import by_name, fleet_message
from flockd.fleet.foxglove.map_places import Message, Places, body_transform, location_fix
from flockd.fleet.foxglove.scene_messages import Scene, SceneDrone, empty_scene, scene_update
from flockd.fleet.foxglove.time_line import TimeLine
from flockd.fleet.page.drone_rows import Known, Row
from flockd.fleet.page.fleet_source import Event, FleetSource, events_after
from flockd.fleet.watcher import Watched
from flockd.onboard.telemetry.preview import EVERY_S

_THREADS = 8
"""That wait for pictures."""


class FleetPublisher:
    """`update` publishes what is new. All on one thread, but for the pictures, which wait on threads of their own."""

    def __init__(self, source: FleetSource, time_line: TimeLine, context: Context) -> None:
        self._source, self._time = source, time_line
        self._channels = FleetChannels(context)
        self._names: dict[str, str] = {}
        self._cameras: dict[str, tuple[Known, Cameras]] = {}
        self._threads = ThreadPoolExecutor(_THREADS, "pictures for Foxglove")
        self._asked_s: dict[tuple[str, str], float] = {}
        self._failure: BaseException | None = None
        self._forget()

    def close(self) -> None:
        """Waits for nothing but a picture that is on its way."""
        self._threads.shutdown(cancel_futures=True)

    def update(self) -> None:
        """Publishes the fleet as it is now on the time line. Raises what a picture's thread met."""
        if self._failure is not None:
            raise self._failure
        time_s = self._time.now_s()
        if self._time.jumped():
            self._forget()
            for channel in self._channels.scene.values():
                channel.log(empty_scene(), log_time=self._ns(time_s))
        watched = {f"{one.fleet}/{one.drone}": one for one in self._source.drones(time_s)}
        rows = {key: row for key, row in self._source.rows(time_s).items() if key in watched}
        for key in sorted(rows):
            self._name(key)
        self._log(rows, time_s)
        self._channels.fleet.log({**fleet_message(rows, self._names)}, log_time=self._ns(time_s))
        messages = {key: self._messages(key, one, time_s) for key, one in watched.items()}
        self._publish_scene(rows, messages, time_s)
        for key, row in rows.items():
            self._look(key, row, messages[key], time_s)

    def _forget(self) -> None:
        """What was published does not count."""
        self._sent: dict[tuple[str, str], float] = {}
        self._told: dict[str, tuple[str, str]] = {}
        self._event: Event | None = None
        self._places, self._scene = Places(), Scene()
        self._asked_s.clear()

    def _name(self, key: str) -> str:
        """A drone's name in topics and frames: its own, with its fleet where another fleet has one of this name."""
        if key not in self._names:
            short = key.partition("/")[2]
            self._names[key] = key if short in self._names.values() else short
        return self._names[key]

    def _messages(self, key: str, drone: Watched, time_s: float) -> dict[str, Message]:
        """A drone's messages that say anything of now; publishes those that are new to whoever subscribed."""
        found = {}
        for topic, heard in drone.topics.items():
            message = drone.message(topic, time_s)
            if message is None or topic not in JSON_TOPICS:
                continue
            found[topic] = message
            channel = self._channels.message(self._names[key], topic)
            if channel.has_sinks() and self._sent.get((key, topic)) != heard.time_s:
                self._sent[key, topic] = heard.time_s
                channel.log({**message}, log_time=self._ns(heard.time_s))
        return found

    def _log(self, rows: Mapping[str, Row], time_s: float) -> None:
        """Events, and why a drone is not well when that changes; all that is remembered to whoever comes first."""
        channel = self._channels.log
        if not channel.has_sinks():
            return
        events = self._source.events(time_s)
        for event in events_after(events, self._event):
            at_s, key, sentence = event
            self._tell(at_s, LogLevel.Info, self._name(key), sentence)
            self._event = event
        for key, row in rows.items():
            told = row["state"], "; ".join(row["why"])
            if self._told.get(key) != told:
                self._told[key] = told
                level = LogLevel.Error if told[0] == GONE else LogLevel.Warning if told[1] else LogLevel.Info
                self._tell(time_s, level, self._names[key], f"{told[0]}: {told[1]}" if told[1] else told[0])

    def _tell(self, time_s: float, level: LogLevel, drone: str, sentence: str) -> None:
        entry = Log(timestamp=self._stamp(time_s), level=level, message=sentence, name=drone)
        self._channels.log.log(entry, log_time=self._ns(time_s))

    def _publish_scene(
        self, rows: Mapping[str, Row], messages: Mapping[str, Mapping[str, Message]], time_s: float
    ) -> None:
        """Places, transforms and all that is drawn."""
        stamp, now_ns = self._stamp(time_s), self._ns(time_s)
        order = by_name(rows, self._names)
        places = self._places.update(rows, order)
        drones: list[SceneDrone] = []
        transforms = []
        for key in (key for key in order if key in places):
            name, state = self._names[key], messages[key].get("state")
            drones.append(self._scene.drone(name, rows[key], places[key], messages[key]))
            transforms.append(body_transform(stamp, name, places[key], state))
            transforms += self._cameras_of(key).transforms(stamp, name)
            fix = None if state is None else location_fix(stamp, name, state)
            if fix is not None:
                self._channels.fix(name).log(fix, log_time=now_ns)
        self._channels.transforms.log(FrameTransforms(transforms=transforms), log_time=now_ns)
        for topic, channel in self._channels.scene.items():
            if channel.has_sinks():
                channel.log(scene_update(topic, drones, stamp), log_time=now_ns)

    def _look(self, key: str, row: Row, messages: Mapping[str, Message], time_s: float) -> None:
        """Asks for a picture of each camera that somebody has subscribed to, once a second."""
        for camera in row["cameras"]:
            channels = self._channels.camera(self._names[key], camera)
            if channels.image.has_sinks() and abs(time_s - self._asked_s.get((key, camera), -EVERY_S)) >= EVERY_S:
                self._asked_s[key, camera] = time_s
                asked = self._threads.submit(self._publish_picture, key, camera, messages, time_s)
                asked.add_done_callback(self._note_failure)

    def _publish_picture(self, key: str, camera: str, messages: Mapping[str, Message], time_s: float) -> None:
        """On a thread of its own: the drone may take seconds to answer."""
        name, cameras = self._names[key], self._cameras_of(key)
        picture = self._source.image(key, camera, time_s)
        if picture is None:
            return
        stamp, now_ns, channels = self._stamp(time_s), self._ns(time_s), self._channels.camera(name, camera)
        calibration = cameras.calibration(now_ns, name, camera, picture)
        if calibration is not None:
            channels.calibration.log(calibration, log_time=now_ns)
        channels.image.log(image(stamp, name, camera, picture), log_time=now_ns)
        channels.tracks.log(cameras.tracks(stamp, camera, picture, messages), log_time=now_ns)

    def _note_failure(self, asked: Future[None]) -> None:
        if not asked.cancelled():
            self._failure = self._failure or asked.exception()

    def _cameras_of(self, key: str) -> Cameras:
        known = self._source.known().get(key, Known())
        if key not in self._cameras or self._cameras[key][0].about is not known.about:
            self._cameras[key] = known, Cameras(known)
        return self._cameras[key][1]

    def _ns(self, time_s: float) -> int:
        return round(1e9 * self._source.wall_s(time_s))

    def _stamp(self, time_s: float) -> Timestamp:
        seconds, nanoseconds = divmod(self._ns(time_s), 1_000_000_000)
        return Timestamp(seconds, nanoseconds)
