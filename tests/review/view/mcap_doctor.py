"""Examines an MCAP file as `mcap doctor` does: what the format's specification promises, and readers rely on."""

from __future__ import annotations

import io
import json
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader, get_chunk_data_stream

MAGIC = b"\x89MCAP0\r\n"
IN_DATA = (Header, Schema, Channel, Message, Chunk, MessageIndex, Attachment, Metadata, DataEnd)


@dataclass
class Examined:
    """What was found, and what is wrong with it."""

    faults: list[str] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[Message] = field(default_factory=list)
    chunks: dict[int, Chunk] = field(default_factory=dict)
    """By where they begin in the file."""
    attachments: dict[int, Attachment] = field(default_factory=dict)
    notes: dict[int, Metadata] = field(default_factory=dict)

    def expect(self, found: object, expected: object, what: str) -> None:
        if found != expected:
            self.faults.append(f"{what}: {found!r} instead of {expected!r}")


def examine(path: Path) -> Examined:
    """Reads all of a file twice: from its begin, and by its index."""
    content = path.read_bytes()
    done = Examined()
    done.expect((content[:8], content[-8:]), (MAGIC, MAGIC), "magic at both ends")
    records = list(_records(content))
    done.expect(type(records[0][1]), Header, "first record")
    end = next(offset for offset, record in records if isinstance(record, DataEnd))
    for offset, record in records:
        if offset <= end:
            _examine_data(done, content, offset, record)
    _examine_summary(done, content, end, [record for offset, record in records if offset > end])
    for message in done.messages:
        decoded(done, message)
    return done


def decoded(done: Examined, message: Message) -> Any:
    """A message by nothing but the schema in the file: JSON as what it holds, protobuf as a generic message."""
    channel = done.channels[message.channel_id]
    schema = done.schemas[channel.schema_id]
    if channel.message_encoding == "json":
        value = json.loads(message.data)
        described = json.loads(schema.data)
        missing = set(described["required"]) - value.keys()
        unknown = value.keys() - described["properties"].keys()
        done.expect((missing, unknown), (set(), set()), f"fields of a message of {channel.topic}")
        return value
    value = message_class(schema)()
    done.expect(value.ParseFromString(message.data), len(message.data), f"bytes read of a message of {channel.topic}")
    return value


def message_class(schema: Schema) -> Any:
    """The class of a protobuf message, from its descriptors alone."""
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    pool = descriptor_pool.DescriptorPool()
    for one in files.file:  # imports first
        pool.Add(one)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def _records(content: bytes) -> Iterator[tuple[int, McapRecord]]:
    """Each record outside of chunks, with where it begins; a wrong checksum of the data raises."""
    stream = io.BytesIO(content)
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True)
    iterator = iter(reader.records)
    offset = len(MAGIC)
    while (record := next(iterator, None)) is not None:
        yield offset, record
        offset += 9 + int.from_bytes(content[offset + 1 : offset + 9], "little")


def _examine_data(done: Examined, content: bytes, offset: int, record: McapRecord) -> None:
    match record:
        case Chunk():
            done.chunks[offset] = record
            _examine_chunk(done, record)
        case Attachment():
            done.attachments[offset] = record
        case Metadata():
            done.notes[offset] = record
        case Schema() | Channel() | Message():
            done.faults.append(f"a {type(record).__name__} stands outside of all chunks")
        case DataEnd(data_section_crc):
            if data_section_crc:
                done.expect(zlib.crc32(content[:offset]), data_section_crc, "checksum of the data")
        case _:
            done.expect(isinstance(record, IN_DATA), True, f"{type(record).__name__} among the data")


def _examine_chunk(done: Examined, chunk: Chunk) -> None:
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    done.expect(chunk.uncompressed_size, length, "size of a chunk")
    done.expect(bool(chunk.uncompressed_crc), True, "a chunk has a checksum")
    times = []
    for record in _in_chunk(stream, length):
        match record:
            case Schema(id=number):
                done.expect(number > 0, True, "number of a schema")
                done.expect(done.schemas.setdefault(number, record), record, f"schema {number} said again")
                done.expect(bool(record.data and record.encoding), True, f"schema {number} says something")
            case Channel(id=number, schema_id=schema):
                done.expect(schema in done.schemas, True, f"schema of channel {number} is known")
                done.expect(done.channels.setdefault(number, record), record, f"channel {number} said again")
            case Message(channel_id=number):
                done.expect(number in done.channels, True, f"channel {number} of a message is known")
                done.messages.append(record)
                times.append(record.log_time)
    span = (min(times, default=0), max(times, default=0))
    done.expect((chunk.message_start_time, chunk.message_end_time), span, "time of a chunk")


def _in_chunk(stream: ReadDataStream, length: int) -> Iterator[McapRecord]:
    while stream.count < length:
        opcode, size = stream.read1(), stream.read8()
        match opcode:
            case Opcode.SCHEMA:
                yield Schema.read(stream)
            case Opcode.CHANNEL:
                yield Channel.read(stream)
            case Opcode.MESSAGE:
                yield Message.read(stream, size)
            case _:
                raise ValueError(f"a record of kind {opcode} has no place in a chunk")


def _examine_summary(done: Examined, content: bytes, end: int, summary: list[McapRecord]) -> None:
    footer = summary[-1]
    assert isinstance(footer, Footer)
    # The checksum covers the summary and of the footer all but the checksum itself and the magic behind it.
    done.expect(zlib.crc32(content[footer.summary_start : -4 - len(MAGIC)]), footer.summary_crc, "summary's checksum")
    done.expect(content[footer.summary_start - 4 - 9], Opcode.DATA_END, "what the summary follows")
    _examine_statistics(done, [record for record in summary if isinstance(record, Statistics)])
    again = [record for record in summary if isinstance(record, Schema)]
    done.expect(sorted(again, key=lambda one: one.id), list(done.schemas.values()), "schemas in the summary")
    channels = [record for record in summary if isinstance(record, Channel)]
    done.expect(sorted(channels, key=lambda one: one.id), list(done.channels.values()), "channels in the summary")
    indexes = [record for record in summary if isinstance(record, ChunkIndex)]
    done.expect([index.chunk_start_offset for index in indexes], list(done.chunks), "chunks in the index")
    for index in indexes:
        _examine_index(done, content, index)
    for kind, found in ((AttachmentIndex, done.attachments), (MetadataIndex, done.notes)):
        pointed = {record.offset: record.name for record in summary if isinstance(record, kind)}
        done.expect(pointed, {offset: one.name for offset, one in found.items()}, kind.__name__)
    for group in (record for record in summary if isinstance(record, SummaryOffset)):
        done.expect(content[group.group_start], group.group_opcode, "what a summary offset points to")


def _examine_statistics(done: Examined, statistics: list[Statistics]) -> None:
    done.expect(len(statistics), 1, "statistics")
    told = statistics[0]
    times = [message.log_time for message in done.messages]
    for what, count, found in (
        ("messages", told.message_count, done.messages),
        ("schemas", told.schema_count, done.schemas),
        ("channels", told.channel_count, done.channels),
        ("chunks", told.chunk_count, done.chunks),
        ("attachments", told.attachment_count, done.attachments),
        ("metadata", told.metadata_count, done.notes),
    ):
        done.expect(count, len(found), f"number of {what}")
    done.expect((told.message_start_time, told.message_end_time), (min(times), max(times)), "time of the file")
    done.expect(told.channel_message_counts, Counter(m.channel_id for m in done.messages), "messages by channel")


def _examine_index(done: Examined, content: bytes, index: ChunkIndex) -> None:
    """An entry of the index against the chunk that it points to, and the chunk's own index of its messages."""
    chunk = done.chunks[index.chunk_start_offset]
    length = 9 + int.from_bytes(content[index.chunk_start_offset + 1 : index.chunk_start_offset + 9], "little")
    told = (index.chunk_length, index.compression, index.compressed_size, index.uncompressed_size)
    done.expect(told, (length, chunk.compression, len(chunk.data), chunk.uncompressed_size), "a chunk in the index")
    times = (index.message_start_time, index.message_end_time)
    done.expect(times, (chunk.message_start_time, chunk.message_end_time), "time of a chunk in the index")
    data = get_chunk_data_stream(chunk)[0].read(chunk.uncompressed_size)
    for channel, offset in index.message_index_offsets.items():
        done.expect(content[offset], Opcode.MESSAGE_INDEX, "what a message index's offset points to")
        stream = ReadDataStream(io.BytesIO(content[offset + 9 :]))
        found = MessageIndex.read(stream)
        done.expect(found.channel_id, channel, "channel of a message index")
        for time_ns, place in found.records:
            size = int.from_bytes(data[place + 1 : place + 9], "little")
            message = Message.read(ReadDataStream(io.BytesIO(data[place + 9 :])), size)
            done.expect((message.channel_id, message.log_time), (channel, time_ns), "a message that is pointed to")
