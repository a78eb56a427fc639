"""Reads recordings, also those of others: sizes and types are checked before anything is used.

A recording whose writer was killed ends in the middle; what came before is read.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from pydantic import ValidationError

from services.recorder.recording import (
    CONFIG,
    ENCODING,
    MAX_CHANNELS,
    RECORDED,
    RECORDING,
    SUMMARY,
    WEIGHTS,
    Origin,
)
from shared import messages as m
from shared import settings
from shared.codec import decode
from shared.config import ActorNumerics
from shared.errors import BadMessage, ConfigError, StateError
from shared.keys import Stream, ident_in

T = TypeVar("T")
MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 128 * 1024 * 1024
"""A longer record, of weights for instance, is refused."""
MAX_WEIGHTS_BYTES = 64 * 1024 * 1024
MAX_VERSIONS = 1_000_000
HEAD = struct.Struct("<BQ")
NUMBER = re.compile(r"[0-9]{1,18}")


@dataclass(frozen=True)
class Weights:
    """Where in the file a version of the target network lies."""

    version: int
    offset: int
    """Place of its record in the file, bytes."""


@dataclass(frozen=True)
class Recorded:
    """A message as it was recorded."""

    stream: Stream
    ident: str
    time_ns: int
    message: m.Message


class Recording:
    """A recording in a file; every pass over it begins anew.

    Args:
        path: The file.

    Raises:
        ConfigError: There is no such file.
        StateError: It is no recording of this project, or is damaged at its beginning.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.complete = False
        """Whether the file came to a clean end."""
        self.summary: dict[str, int] = {}
        """Counts that the recorder left behind; empty if it was killed."""
        self.weights: dict[int, Weights] = {}
        self.undecodable = 0
        """Messages that the newest pass of `messages` could not decode."""
        about: dict[str, dict[str, str]] = {}
        for offset, opcode, body in self._records(whole=False):
            if opcode == Opcode.METADATA:
                found = self._parse(Metadata.read, body)
                if found.name in (RECORDING, CONFIG):
                    about.setdefault(found.name, found.metadata)
                elif found.name == SUMMARY:
                    numbers = {k: v for k, v in found.metadata.items() if NUMBER.fullmatch(v)}
                    self.summary = {name: int(text) for name, text in numbers.items()}
            elif opcode == Opcode.ATTACHMENT:
                self._note_weights(offset, body)
            elif opcode == Opcode.FOOTER:
                self.complete = True
        self.origin = self._origin(about)

    def messages(self) -> Iterator[Recorded]:
        """All messages in the order in which they were recorded.

        What is no message of the protocol is counted and left out. Raises StateError.
        """
        self.undecodable = 0
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[Stream, str] | None] = {}
        for _, opcode, body in self._records(whole=True):
            if opcode == Opcode.CHUNK:
                inside = self._in_chunk(self._parse(Chunk.read, body))
            else:
                inside = iter([(opcode, body)])
            for kind, part in inside:
                if kind == Opcode.SCHEMA and len(schemas) < MAX_CHANNELS:
                    schema = self._parse(Schema.read, part)
                    schemas[schema.id] = schema
                elif kind == Opcode.CHANNEL and len(channels) < MAX_CHANNELS:
                    channel = self._parse(Channel.read, part)
                    channels[channel.id] = self._stream(channel, schemas)
                elif kind == Opcode.MESSAGE:
                    recorded = self._message(part, channels)
                    if recorded is None:
                        self.undecodable += 1
                    else:
                        yield recorded

    def load(self, weights: Weights) -> bytes:
        """The safetensors bytes of a version, as they were written. Raises StateError."""
        with self._path.open("rb") as file:
            file.seek(weights.offset)
            _, body = self._record(file, self._path.stat().st_size) or (0, b"")
        data: bytes = self._parse(Attachment.read, body).data
        if int.from_bytes(body[-4:], "little") not in (0, zlib.crc32(body[:-4])):  # 0: none told
            raise StateError(
                f"{self._path}: damaged: weights {weights.version} do not match their checksum"
            )
        return data

    def _records(self, *, whole: bool) -> Iterator[tuple[int, int, bytes]]:
        """Offset, opcode and content of the records up to where the file ends or breaks off.

        Without `whole` chunks come without their content.
        """
        try:
            with self._path.open("rb") as file:
                size = self._path.stat().st_size
                if file.read(len(MAGIC)) != MAGIC:
                    raise StateError(f"{self._path}: not an MCAP file")
                while True:
                    offset = file.tell()
                    found = self._record(file, size, skip=() if whole else (Opcode.CHUNK,))
                    if found is None:
                        return
                    yield offset, *found
                    if found[0] == Opcode.FOOTER:
                        return
        except FileNotFoundError as error:
            raise ConfigError(f"{self._path}: there is no such file") from error
        except OSError as error:
            raise StateError(f"{self._path}: cannot be read: {error.strerror}") from error

    def _record(
        self, file: BinaryIO, size: int, skip: tuple[int, ...] = ()
    ) -> tuple[int, bytes] | None:
        """The next record; None where the file breaks off."""
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(head)
        if length > size - file.tell():
            return None
        if length > MAX_RECORD_BYTES:
            raise StateError(
                f"{self._path}: a record of {length} bytes, at most {MAX_RECORD_BYTES}"
            )
        if opcode in skip:
            file.seek(length, 1)
            return opcode, b""
        return opcode, file.read(length)

    def _in_chunk(self, chunk: Chunk) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of the records in a chunk. Raises StateError."""
        if chunk.compression:
            raise StateError(
                f"{self._path}: compressed by {chunk.compression!r:.20}: decompress it first"
            )
        if chunk.uncompressed_crc not in (0, zlib.crc32(chunk.data)):
            raise StateError(f"{self._path}: damaged: a chunk does not match its checksum")
        place, data = 0, memoryview(chunk.data)
        while place < len(data):
            if len(data) - place < HEAD.size:
                raise StateError(f"{self._path}: damaged: a chunk ends in the middle of a record")
            opcode, length = HEAD.unpack_from(data, place)
            place += HEAD.size
            if length > len(data) - place:
                raise StateError(f"{self._path}: damaged: a record is longer than its chunk")
            yield opcode, bytes(data[place : place + length])
            place += length

    def _parse(self, read: Callable[[ReadDataStream], T], body: bytes) -> T:
        """A record from its content, by the reader of its class. Raises StateError."""
        try:
            return read(ReadDataStream(BytesIO(body)))
        except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
            raise StateError(f"{self._path}: damaged: {error or type(error).__name__}") from error

    def _note_weights(self, offset: int, body: bytes) -> None:
        attachment = self._parse(Attachment.read, body)
        number = attachment.name.removeprefix(WEIGHTS)
        if attachment.name == number or not NUMBER.fullmatch(number):
            return
        if len(attachment.data) > MAX_WEIGHTS_BYTES or len(self.weights) >= MAX_VERSIONS:
            raise StateError(f"{self._path}: {attachment.name}: too large, or too many versions")
        self.weights[int(number)] = Weights(int(number), offset)

    def _stream(self, channel: Channel, schemas: dict[int, Schema]) -> tuple[Stream, str] | None:
        """The stream a channel is of; None for anything but the protocol's."""
        schema = schemas.get(channel.schema_id)
        if schema is None or channel.message_encoding != ENCODING:
            return None
        for stream in RECORDED:
            ident = ident_in(stream, channel.topic)
            if ident is not None and schema.name == stream.request.__name__:
                return stream, ident
        return None

    def _message(
        self, body: bytes, channels: dict[int, tuple[Stream, str] | None]
    ) -> Recorded | None:
        message = self._parse(lambda stream: Message.read(stream, len(body)), body)
        where = channels.get(message.channel_id)
        if where is None or len(message.data) > where[0].max_bytes:
            return None
        stream, ident = where
        try:
            decoded: m.Message = decode(message.data, stream.request)
        except BadMessage:
            return None
        if "{id}" in stream.pattern and getattr(decoded, "robot", ident) != ident:
            return None
        return Recorded(stream, ident, message.log_time, decoded)

    def _origin(self, about: dict[str, dict[str, str]]) -> Origin:
        try:
            facts = about[RECORDING]
            config = settings.from_toml(about[CONFIG]["toml"], str(self._path))
            numerics = ActorNumerics.model_validate(json.loads(facts["numerics.actor"]))
            protocol, preprocessing = int(facts["protocol"]), int(facts["preprocessing"])
        except KeyError as error:
            raise StateError(f"{self._path}: no recording of a run: lacks {error}") from error
        except (ConfigError, ValidationError, ValueError, RecursionError) as error:
            text = str(error).splitlines()[0]
            raise StateError(f"{self._path}: what it says of its run is damaged: {text}") from error
        return Origin(config, numerics, protocol, preprocessing)
