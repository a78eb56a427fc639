"""Reads recordings, also those of others: sizes and types are checked before anything is used.

A recording whose writer was killed ends in the middle; what came before is read.
"""

import json
import re
import struct
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
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
from shared.keys import Stream, check_sender, ident_in

MAX_RECORD_BYTES = 128 * 1024 * 1024
"""A longer record, of weights for instance, is refused."""
MAX_CHUNK_BYTES = 16 * 1024 * 1024
"""A chunk that is larger once it is decompressed is refused."""
MAX_WEIGHTS_BYTES = 64 * 1024 * 1024
MAX_VERSIONS = 1_000_000
NUMBER = re.compile(r"[0-9]{1,18}")
WEIGHTS_NAME = re.compile(rf"{WEIGHTS}([0-9]{{1,18}})")
KEPT_OBSERVATIONS = 256
"""Observations kept for all robots together. An action follows its observation closely."""
Place = tuple[str, str, int, int]


class _File(BufferedReader):
    """A file that gives all that is asked for or nothing, and never very much at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        """So many bytes. Raises EndOfFile where the file has fewer, McapError for too many."""
        if size is None or not 0 <= size <= MAX_RECORD_BYTES:
            raise McapError(f"{size} bytes in one piece, at most {MAX_RECORD_BYTES}")
        data = super().read(size)
        if len(data) < size:
            raise EndOfFile
        return data


class _Reader(StreamReader):
    """The records of a file, those in chunks among them unless these are wanted whole."""

    def __init__(self, file: _File, *, chunks: bool = False, skip_magic: bool = False) -> None:
        super().__init__(
            file, skip_magic, chunks, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES
        )
        self._file, self.offset = file, 0
        """Where the newest record begins."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        self.offset = self._file.tell() - 9  # opcode and length
        record = super()._read_record(opcode, length)
        if isinstance(record, Chunk):
            size = record.uncompressed_size
            if record.compression == "zstd":
                size = max(size, zstandard.frame_content_size(record.data))
            elif record.compression:
                raise McapError(f"compressed by {record.compression!r:.20}, expected zstd")
            if size > MAX_CHUNK_BYTES:
                raise McapError(f"a chunk of {size} bytes, at most {MAX_CHUNK_BYTES}")
        return record


class Recording:
    """A recording in a file; every pass over it begins anew.

    Raises ConfigError if there is none, StateError if it is no recording of this project, or is
    damaged at its beginning.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.complete = False
        """Whether the file came to a clean end."""
        self.summary: dict[str, int] = {}
        """Counts that the recorder left behind; empty if it was killed."""
        self.weights: dict[int, int] = {}
        """Where in the file each version of the target network lies, bytes."""
        self.undecodable = 0
        """Messages that the newest pass of `messages` could not decode."""
        about: dict[str, dict[str, str]] = {}
        for offset, record in self._records(chunks=True):
            if isinstance(record, Metadata):
                if record.name in (RECORDING, CONFIG):
                    about.setdefault(record.name, record.metadata)
                elif record.name == SUMMARY:
                    numbers = {k: v for k, v in record.metadata.items() if NUMBER.fullmatch(v)}
                    self.summary = {name: int(text) for name, text in numbers.items()}
            elif isinstance(record, Attachment) and (name := WEIGHTS_NAME.fullmatch(record.name)):
                if len(record.data) > MAX_WEIGHTS_BYTES or len(self.weights) >= MAX_VERSIONS:
                    raise StateError(f"{path}: {record.name}: too large, or too many versions")
                self.weights[int(name[1])] = offset
            self.complete = isinstance(record, Footer)
        self.origin = self._origin(about)

    def messages(self) -> Iterator[m.Message]:
        """All messages in the order in which they were recorded.

        Channels for other tools are left out. What else is no message of the protocol is counted.
        Raises StateError.
        """
        self.undecodable = 0
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[Stream, str] | None] = {}
        views: set[int] = set()
        for _, record in self._records():
            if isinstance(record, Schema) and len(schemas) < MAX_CHANNELS:
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.message_encoding != ENCODING:
                views.add(record.id)
            elif isinstance(record, Channel):
                channels[record.id] = _stream(record, schemas)
            elif isinstance(record, Message) and record.channel_id not in views:
                message = _decoded(record, channels.get(record.channel_id))
                if message is not None:
                    yield message
                self.undecodable += message is None

    def turns(self) -> Iterator[tuple[m.Observation | None, m.Action]]:
        """All actions, each with the observation that it answers, if that is there."""
        seen: OrderedDict[Place, m.Observation] = OrderedDict()
        for message in self.messages():
            if isinstance(message, m.Observation):
                seen[(message.robot, message.life, message.sequence, message.attempt)] = message
                if len(seen) > KEPT_OBSERVATIONS:
                    seen.popitem(last=False)
            elif isinstance(message, m.Action):
                place = (message.robot, message.robot_life, message.sequence, message.attempt)
                yield seen.get(place), message

    def load(self, version: int) -> bytes:
        """The safetensors bytes of a version, as they were written. Raises StateError."""
        with self._guarded(), _File(FileIO(self._path)) as file:
            file.seek(self.weights[version])
            attachment = next(iter(_Reader(file, skip_magic=True).records))
            assert isinstance(attachment, Attachment)
            file.seek(-4, 1)
            told, again = file.read(4), RecordBuilder()
            attachment.write(again)
            if told not in (bytes(4), again.end()[-4:]):  # type: ignore[no-untyped-call]
                raise McapError(f"weights {version} do not match their checksum")
            return attachment.data

    def _records(self, *, chunks: bool = False) -> Iterator[tuple[int, McapRecord]]:
        """Offset and content of the records up to where the file ends or breaks off."""
        with self._guarded(), _File(FileIO(self._path)) as file:
            reader = _Reader(file, chunks=chunks)
            try:
                for record in reader.records:
                    yield reader.offset, record
                    if isinstance(record, Footer):
                        return
            except EndOfFile:
                return

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Say what is wrong with the file in one line. Raises ConfigError or StateError."""
        try:
            yield
        except FileNotFoundError as error:
            raise ConfigError(f"{self._path}: there is no such file") from error
        except InvalidMagic as error:
            raise StateError(f"{self._path}: not an MCAP file") from error
        except OSError as error:
            raise StateError(f"{self._path}: cannot be read: {error.strerror}") from error
        except (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError) as error:
            raise StateError(f"{self._path}: damaged: {error or type(error).__name__}") from error

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


def _stream(channel: Channel, schemas: dict[int, Schema]) -> tuple[Stream, str] | None:
    """The stream a channel is of; None for anything but the protocol's."""
    schema = schemas.get(channel.schema_id)
    if schema is None:
        return None
    for stream in RECORDED:
        ident = ident_in(stream, channel.topic)
        if ident is not None and schema.name == stream.request.__name__:
            return stream, ident
    return None


def _decoded(record: Message, where: tuple[Stream, str] | None) -> m.Message | None:
    """The message of the protocol, if it is one."""
    if where is None or len(record.data) > where[0].max_bytes:
        return None
    stream, ident = where
    try:
        message: m.Message = decode(record.data, stream.request)
        check_sender(stream, ident, message)
    except BadMessage:
        return None
    return message
