"""The one adapter to `rosbags`: ROS 2's bags, in MCAP or SQLite, written and read without ROS."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np

from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.ros.message_trees import Tree

Storage = Literal["mcap", "sqlite3"]
METADATA = "metadata.yaml"
VERSION: Final = 9
"""Of the metadata: ROS 2 Jazzy and later write it, and earlier ones read it too."""


def is_bag(path: Path) -> bool:
    """Whether it is the folder of a bag."""
    return (path / METADATA).is_file()


class BagMessage(NamedTuple):
    """One message of a bag."""

    topic: str
    kind: str
    time_ns: int
    data: bytes
    """As it travels (CDR)."""


class BagWriter:
    """Writes one bag between ``__enter__`` and ``__exit__``. Raises OSError; ModuleNotFoundError without `rosbags`."""

    def __init__(self, folder: Path, storage: Storage) -> None:
        """``folder`` must not exist."""
        from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - of an extra

        self._store = _store()
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        self._writer = Writer(folder, version=VERSION, storage_plugin=plugin)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def write(self, topic: str, kind: str, time_ns: int, tree: Tree) -> None:
        """Adds a message."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        data = self._store.serialize_cdr(self._message(kind, tree), kind)
        self._writer.write(self._connections[topic], time_ns, data)

    def _message(self, kind: str, tree: Mapping[str, Any]) -> Any:
        fields = {name: self._field(field, tree[name]) for name, field in self._store.fielddefs[kind][1]}
        return self._store.types[kind](**fields)

    def _field(self, field: Any, value: Any) -> Any:
        """``field``: the node's type as `rosbags` has it, with what it is of."""
        node, of = field
        if isinstance(value, Mapping):
            return self._message(of, value)
        if isinstance(value, bytes):
            return np.frombuffer(value, np.uint8)
        if node.name in {"SEQUENCE", "ARRAY"} and isinstance(value, list):
            return [self._field(of[0], one) for one in value]
        return value


class Bag:
    """A bag that is read. Raises RecordingError for what is none, and ModuleNotFoundError without `rosbags`."""

    def __init__(self, folder: Path) -> None:
        from rosbags.rosbag2 import Reader, ReaderError  # noqa: PLC0415 - of an extra

        self.path = folder
        self._store = _store()
        try:
            self._reader = Reader(folder)
            self._reader.open()
        except (ReaderError, OSError, ValueError, KeyError) as error:
            raise RecordingError(f"{folder}: is no bag that can be read ({error}); use another copy") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def kinds(self) -> dict[str, str]:
        """The type of each topic."""
        return {one.topic: one.msgtype for one in self._reader.connections}

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Of these topics, in the order of their times. Raises RecordingError where it is damaged."""
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
        """A message's fields as attributes, of the standard types. Raises RecordingError."""
        try:
            return self._store.deserialize_cdr(message.data, message.kind)
        except Exception as error:  # of generated code: struct.error, UnicodeDecodeError and others
            raise RecordingError(f"{self.path}: a message of {message.topic} cannot be read ({error})") from error


def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - of an extra

    return get_typestore(Stores.ROS2_JAZZY)
