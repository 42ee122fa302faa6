"""MCAP files as data from outside: records found by position, sizes checked before memory is taken, cut-off ends kept.

The package ``mcap`` reads a file through its index, which a killed writer has not written, and believes the sizes that
compressed data claim. Here a file is walked once from record to record, without unpacking; chunks are unpacked one at a
time and no larger than `MAX_BYTES`.
"""

import io
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Schema
from mcap.writer import MCAP0_MAGIC

from simtrack.errors import FileFormatError

MAX_BYTES = 2**29
"""Largest record, and largest chunk when unpacked."""

_RECORD_HEADER = struct.Struct("<BQ")
_Record = TypeVar("_Record")


@dataclass(frozen=True, slots=True)
class ChunkPosition:
    """Where a chunk lies."""

    offset: int
    """Of the record's body, bytes."""
    length: int
    """Bytes."""
    channels: frozenset[int] | None
    """Numbers of the channels that have messages in it, None if the file does not say."""


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message with its channel."""

    channel: Channel
    schema: Schema | None
    message: Message


class Container:
    """The chunks and attachments of one MCAP file. Raises `FileFormatError` for what is no MCAP file."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.attachments: dict[str, tuple[int, int]] = {}
        """Name -> (offset, length) of the record's body."""
        self.chunks: list[ChunkPosition] = []
        self.complete = False
        """Whether the file was finished by its writer; a cut-off file holds everything before the cut."""
        try:
            with self.path.open("rb") as stream:
                self._walk(stream)
        except OSError as error:
            raise FileFormatError(path, "", f"cannot be read: {error.strerror or error}") from error

    def attachment(self, name: str) -> bytes | None:
        """Content of the attachment, None if there is none of this name."""
        if name not in self.attachments:
            return None
        with self.path.open("rb") as stream:
            body = self._body(stream, *self.attachments[name])
        return self._parse(Attachment.read, body, f"attachment {name}").data

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[LogMessage]:
        """Messages in the order of the file, of all or of some topics; holds one chunk in memory at a time."""
        wanted = None if topics is None else frozenset(topics)
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self.path.open("rb") as stream:
            for position in self.chunks:
                if wanted is not None and position.channels is not None:
                    known_useless = {i for i, channel in channels.items() if channel.topic not in wanted}
                    if position.channels <= known_useless:
                        continue
                for opcode, body in self._chunk_records(stream, position):
                    if opcode == Opcode.SCHEMA:
                        schema = self._parse(Schema.read, body, "schema")
                        schemas[schema.id] = schema
                    elif opcode == Opcode.CHANNEL:
                        channel = self._parse(Channel.read, body, "channel")
                        channels[channel.id] = channel
                    elif opcode == Opcode.MESSAGE:
                        message = self._parse(partial(Message.read, length=len(body)), body, "message")
                        channel = channels.get(message.channel_id)
                        if channel is None:
                            raise FileFormatError(self.path, f"channel {message.channel_id}", "used but not declared")
                        if wanted is None or channel.topic in wanted:
                            yield LogMessage(channel, schemas.get(channel.schema_id), message)

    def _walk(self, stream: BinaryIO) -> None:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise FileFormatError(self.path, "", "not an MCAP file (it does not begin with the MCAP signature)")
        chunk: tuple[int, int] | None = None
        indexed: set[int] = set()
        while True:
            header = stream.read(_RECORD_HEADER.size)
            if len(header) < _RECORD_HEADER.size:
                break
            opcode, length = _RECORD_HEADER.unpack(header)
            offset = stream.tell()
            if length > size - offset:
                break
            if opcode == Opcode.MESSAGE_INDEX:
                indexed.add(self._parse(ReadDataStream.read2, self._body(stream, offset, min(length, 2)), "index"))
            elif chunk is not None:
                self.chunks.append(ChunkPosition(*chunk, frozenset(indexed) if indexed else None))
                chunk, indexed = None, set()
            if opcode == Opcode.CHUNK:
                chunk, indexed = (offset, length), set()
            elif opcode == Opcode.ATTACHMENT:
                # Data follow the name in the record: its head is enough to find it again.
                head = self._body(stream, offset, min(length, 65_536))
                self.attachments[self._parse(_attachment_name, head, "attachment")] = (offset, length)
            elif opcode == Opcode.MESSAGE:
                raise FileFormatError(self.path, f"message at byte {offset}", "outside a chunk; write with chunks")
            elif opcode == Opcode.FOOTER:
                stream.seek(offset + length)
                self.complete = stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
                break
            stream.seek(offset + length)
        if chunk is not None:
            # The indexes after it may be cut off with the rest.
            self.chunks.append(ChunkPosition(*chunk, None))

    def _chunk_records(self, stream: BinaryIO, position: ChunkPosition) -> Iterator[tuple[int, bytes]]:
        """(opcode, body) of each record in a chunk."""
        where = f"chunk at byte {position.offset}"
        chunk = self._parse(Chunk.read, self._body(stream, position.offset, position.length), where)
        if chunk.uncompressed_size > MAX_BYTES:
            raise FileFormatError(self.path, where, f"claims {chunk.uncompressed_size} bytes, at most {MAX_BYTES}")
        data = self._parse(lambda _: _unpack(chunk), b"", where)
        if len(data) != chunk.uncompressed_size or (
            chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc
        ):
            raise FileFormatError(self.path, where, "checksum or size does not match: the file is damaged")
        at = 0
        while at < len(data):
            opcode, length = _RECORD_HEADER.unpack_from(data, at) if at + _RECORD_HEADER.size <= len(data) else (0, 0)
            at += _RECORD_HEADER.size
            if opcode == 0 or length > len(data) - at:
                raise FileFormatError(self.path, where, f"damaged at byte {at} of its content")
            yield opcode, data[at : at + length]
            at += length

    def _body(self, stream: BinaryIO, offset: int, length: int) -> bytes:
        if length > MAX_BYTES:
            raise FileFormatError(self.path, f"record at byte {offset}", f"{length} bytes, at most {MAX_BYTES}")
        stream.seek(offset)
        body = stream.read(length)
        if len(body) != length:
            raise FileFormatError(self.path, f"record at byte {offset}", "the file became shorter while it was read")
        return body

    def _parse(self, parse: Callable[[ReadDataStream], _Record], body: bytes, where: str) -> _Record:
        try:
            return parse(ReadDataStream(io.BytesIO(body)))
        except (McapError, struct.error, ValueError, OverflowError) as error:
            raise FileFormatError(self.path, where, f"damaged: {str(error) or type(error).__name__}") from error


def _attachment_name(stream: ReadDataStream) -> str:
    stream.read(16)  # times
    return stream.read_prefixed_string()


def _unpack(chunk: Chunk) -> bytes:
    """Uncompressed records of a chunk; the caller has bounded `uncompressed_size`."""
    if chunk.compression == "":
        return chunk.data
    if chunk.compression != "zstd":
        raise ValueError(f"compression {chunk.compression!r}; known: zstd, none")
    try:
        # The size that the zstd frame itself claims would win over max_output_size.
        claimed = zstandard.get_frame_parameters(chunk.data).content_size
        if claimed not in (chunk.uncompressed_size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(f"zstd frame claims {claimed} bytes, its chunk {chunk.uncompressed_size}")
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
