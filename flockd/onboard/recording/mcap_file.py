"""The adapter of the MCAP format: writes it in small chunks, and reads all intact parts of a file."""

from __future__ import annotations

import dataclasses
import io
import os
import struct
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, Self

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from flockd.core.data import LFS_POINTER
from flockd.core.errors import FlockdError

CHUNK_BYTES = 100_000
"""The most that a killed writer loses, besides data that it had no time to flush."""
SYNC_EVERY_S = 1.0
"""The most that a loss of power costs, if the disk keeps what it confirms."""
_KNOWN = {Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA, Opcode.ATTACHMENT}
_MAGIC = b"\x89MCAP0\r\n"
_UNKNOWN = "it does not begin as MCAP files do); name another file"
_OTHERS = {
    b"#ROSBAG": "but a bag of ROS 1); make one of ROS 2 of it with `rosbags-convert`",
    LFS_POINTER[:8]: "but a pointer of Git LFS); fetch the file with `git lfs pull`",
    b"ULog": "but PX4's log); open it in Flight Review or PlotJuggler",
    b"\x28\xb5\x2f\xfd": "but packed by zstd); unpack it with `unzstd`",
    b"\x1f\x8b": "but packed by gzip); unpack it with `gunzip`",
}
"""First bytes of files that are mistaken for recordings, and what they are."""
_HEAD = struct.Struct("<BQ")
MAX_RECORD_BYTES = 256 << 20
"""Largest record, and chunk uncompressed; larger ones count as damaged. The largest real ones hold one image."""
# RuntimeError and EOFError: lz4; ValueError: a wrong checksum, text that is not UTF-8; OverflowError: sizes over 2^63
_BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError, RuntimeError, EOFError, MemoryError)


class RecordingError(FlockdError):
    """A file is not a recording, or cannot be used as asked."""


Encoding = Literal["json", "protobuf"]


@dataclass(frozen=True)
class Stream:
    """One topic of a file and the schema of its messages."""

    topic: str
    encoding: Encoding
    schema_name: str
    schema: bytes
    """A JSON schema, or a serialised protobuf FileDescriptorSet."""


@dataclass(frozen=True)
class Entry:
    """One message of a file."""

    stream: Stream
    time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class Note:
    """Named facts about the whole file."""

    name: str
    facts: Mapping[str, str]


@dataclass(frozen=True)
class Inclosure:
    """A file embedded in the file."""

    name: str
    media_type: str
    data: bytes


Record = Entry | Note | Inclosure


@dataclass(frozen=True)
class Damage:
    """Where and why a file is unreadable from here on, or one chunk of it is."""

    offset: int
    reason: str
    at_end: bool
    """Whether the file just stops, or zeros follow: its writer was killed. Otherwise it is damaged inside."""


class McapFile:
    """Writes one new file. Every method may raise OSError; after that only `abandon` may be called."""

    def __init__(self, path: Path) -> None:
        """Raises FileExistsError rather than to write over a file."""
        self.path = path
        self._file = path.open("xb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        self._synced_s = time.monotonic()
        self._syncing: threading.Thread | None = None
        self._sync_error: OSError | None = None
        try:
            self._writer.start(library="flockd")
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """Bytes so far, without the chunk in progress."""
        return self._file.tell()

    def write(self, record: Record) -> None:
        """Adds a record; notes and inclosures go straight to the file, entries into a chunk."""
        match record:
            case Entry(stream, time_ns, sequence, data):
                self._writer.add_message(self._channel(stream), time_ns, data, time_ns, sequence)
            case Note(name, facts):
                self._writer.add_metadata(name, dict(facts))
            case Inclosure(name, media_type, data):
                self._writer.add_attachment(0, 0, name, media_type, data)

    def flush(self) -> None:
        """Ends the chunk and hands it to the system; about once a second also to the disk."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._sync_error is not None:
            raise self._sync_error
        now_s = time.monotonic()
        if now_s - self._synced_s >= SYNC_EVERY_S and not (self._syncing and self._syncing.is_alive()):
            self._synced_s = now_s
            self._syncing = threading.Thread(target=self._sync, args=(os.dup(self._file.fileno()),), daemon=True)
            self._syncing.start()

    def finish(self) -> None:
        """Writes the index and closes the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Closes the file as it is, without another byte: its contents can be recovered."""
        self._file.raw.close()  # closing the buffered file would try to write once more

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.finish()
        else:
            self.abandon()

    def _sync(self, descriptor: int) -> None:
        """On a thread of its own: a slow disk takes long, and a simulator waits for the messages."""
        try:
            os.fsync(descriptor)
        except OSError as error:
            self._sync_error = error
        finally:
            os.close(descriptor)

    def _channel(self, stream: Stream) -> int:
        if stream.topic not in self._channels:
            encoding = "jsonschema" if stream.encoding == "json" else stream.encoding
            schema = self._writer.register_schema(stream.schema_name, encoding, stream.schema)
            self._channels[stream.topic] = self._writer.register_channel(stream.topic, stream.encoding, schema)
        return self._channels[stream.topic]


def read_records(path: Path) -> Iterator[Record | Damage]:
    """All records in the order of writing, and damages.

    A damaged chunk is yielded as `Damage`; if the file stops before its end, that comes last. Raises RecordingError if
    it is not an MCAP file, and OSError.
    """
    with path.open("rb") as file:
        if (head := file.read(len(_MAGIC))) != _MAGIC:
            told = next((told for others, told in _OTHERS.items() if head.startswith(others)), _UNKNOWN)
            raise RecordingError(f"{path}: is not a recording ({told}")
        yield from _Reader(file).records()


def read_entries(path: Path) -> Iterator[Entry]:
    """The readable messages only."""
    return (record for record in read_records(path) if isinstance(record, Entry))


class _Reader:
    """Steps from record to record by their lengths, so that a broken record does not hide the next."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._schemas: dict[int, Schema] = {}
        self._streams: dict[int, Stream] = {}

    def records(self) -> Iterator[Record | Damage]:
        while True:
            offset = self._file.tell()
            head = self._file.read(_HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            if opcode == Opcode.FOOTER:
                end = self._file.seek(length + len(_MAGIC), io.SEEK_CUR)
                if end < self._size:
                    yield Damage(
                        end,
                        f"{self._size - end:,} bytes, as of a second file, follow its end and are not read",
                        at_end=False,
                    )
                return
            if opcode == 0 or offset + _HEAD.size + length > self._size:
                yield Damage(offset, "it stops without an end", at_end=True)
                return
            if length > MAX_RECORD_BYTES:
                yield Damage(offset, f"a record is {length:,} bytes long", at_end=False)
                self._file.seek(length, io.SEEK_CUR)
                continue
            whole = head + self._file.read(length)
            try:
                found = list(self._parsed(opcode, whole))
            except _BROKEN as error:
                name = Opcode(opcode).name.lower()
                yield Damage(offset, f"a {name} cannot be read ({error})", at_end=False)
            else:
                yield from found

    def _parsed(self, opcode: int, whole: bytes) -> Iterator[Record]:
        if opcode in _KNOWN:
            record = next(StreamReader(io.BytesIO(whole), skip_magic=True, emit_chunks=True).records)
            if isinstance(record, Chunk):
                for inner in breakup_chunk(_uncompressed(record), validate_crc=True):
                    yield from self._unpacked(inner)
            yield from self._unpacked(record)

    def _unpacked(self, record: object) -> Iterator[Record]:
        match record:
            case Metadata(name=name, metadata=facts):
                yield Note(name, facts)
            case Attachment(name=name, media_type=kind, data=data):
                yield Inclosure(name, kind, data)
            case Schema():
                self._schemas[record.id] = record
            case Channel():
                schema = self._schemas.get(record.schema_id)
                name, data = (schema.name, schema.data) if schema else ("", b"")
                encoding: Encoding = "protobuf" if record.message_encoding == "protobuf" else "json"
                self._streams[record.id] = Stream(record.topic, encoding, name, data)
            case Message() if record.channel_id in self._streams:  # else its channel was in a damaged chunk
                yield Entry(self._streams[record.channel_id], record.log_time, record.sequence, record.data)


def _uncompressed(chunk: Chunk) -> Chunk:
    """The chunk without compression, in no more memory than it declares. Raises ValueError and those of `_BROKEN`."""
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES:
        raise ValueError(f"{size:,} bytes uncompressed")
    match chunk.compression:
        case "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
        case "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        case _:
            return chunk
    if len(data) != size:
        raise ValueError("its uncompressed size is not what it says")
    return dataclasses.replace(chunk, compression="", data=data)
