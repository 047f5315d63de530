"""The one adapter to `rosbags`: ROS 2's bags, in MCAP or SQLite, read without ROS."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

from flockd.onboard.recording.mcap_file import RecordingError

METADATA = "metadata.yaml"


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
