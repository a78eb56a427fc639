"""The form of a recording: what an MCAP file holds of a run, and a writer of it.

| in the file | what it is |
|---|---|
| channel | one key of the protocol; encoding `msgpack`, bytes as they were on the wire |
| schema | name of the message, its fields as JSON schema |
| metadata `recording` | run, protocol, version of preprocessing, numerics of the actor |
| metadata `config` | the configuration of the run as TOML, seed included |
| attachment `weights/<version>` | the target network of that version as safetensors |
| metadata `summary` | counts, once the recording came to a clean end |

Chunks are not compressed, so that a reader can bound what it takes into memory before it does.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self

from mcap.writer import CompressionType, Writer

from services.recorder.tap import Heard
from shared.config import Config, Numerics
from shared.errors import ConfigError
from shared.keys import STREAMS, Stream
from shared.messages import PROTOCOL_VERSION
from shared.rl.preprocess import PREPROCESS_VERSION
from shared.settings import to_toml

PROFILE, ENCODING, SCHEMA_ENCODING = "corridor", "msgpack", "jsonschema"
RECORDING, CONFIG, SUMMARY, WEIGHTS = "recording", "config", "summary", "weights/"
CHUNK_BYTES = 256 * 1024
MAX_CHANNELS = 512
"""Keys of one recording; messages of more are refused and counted."""
RECORDED: tuple[Stream, ...] = tuple(s for s in STREAMS if s.delivery == "latest")
"""Everything that is published. Requests and answers are between two parties only."""


@dataclass(frozen=True)
class Origin:
    """The run that a recording is of, and all that decides what its actor chooses."""

    config: Config
    numerics: Numerics
    """Settled numerics of the actor."""
    protocol: int = PROTOCOL_VERSION
    preprocessing: int = PREPROCESS_VERSION


class RecordingWriter:
    """Writes one recording. Use as a context manager: leaving it completes the file.

    What `flush` was called for is readable whatever happens to this process.

    Args:
        path: New file.
        origin: Which run.

    Raises:
        ConfigError: The file exists or cannot be made.
    """

    def __init__(self, path: Path, origin: Origin) -> None:
        self.messages = self.refused = 0
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._run = origin.config.run.name
        self._file = _create(path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(PROFILE)
        about = {
            "run": self._run,
            "protocol": str(origin.protocol),
            "preprocessing": str(origin.preprocessing),
            "numerics.actor": json.dumps(origin.numerics.model_dump()),
        }
        self._writer.add_metadata(RECORDING, about)
        self._writer.add_metadata(CONFIG, {"toml": to_toml(origin.config)})
        self.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:  # else the file breaks off, as after a kill, and is read as such
                self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    def add(self, heard: Heard) -> None:
        """Write a message."""
        channel = self._channel(heard.stream, heard.ident)
        if channel is None:
            self.refused += 1
            return
        self._writer.add_message(
            channel, heard.time_ns, heard.data, heard.time_ns, sequence=self.messages % 2**32
        )
        self.messages += 1

    def add_weights(self, version: int, data: bytes, time_ns: int) -> None:
        """Write a version of the target network, given as safetensors bytes."""
        media_type = "application/octet-stream"
        self._writer.add_attachment(time_ns, time_ns, f"{WEIGHTS}{version}", media_type, data)

    def add_summary(self, counts: dict[str, int]) -> None:
        """Write how much there is, and how much was lost."""
        self._writer.add_metadata(SUMMARY, {name: str(count) for name, count in counts.items()})

    def flush(self) -> None:
        """Hand everything so far to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def _channel(self, stream: Stream, ident: str) -> int | None:
        place = (stream.name, ident)
        if place not in self._channels:
            if len(self._channels) >= MAX_CHANNELS:
                return None
            name = stream.request.__name__
            if name not in self._schemas:
                schema = json.dumps(stream.request.model_json_schema()).encode()
                self._schemas[name] = self._writer.register_schema(name, SCHEMA_ENCODING, schema)
            key = stream.key(self._run, ident)
            self._channels[place] = self._writer.register_channel(
                key, ENCODING, self._schemas[name]
            )
        return self._channels[place]


def _create(path: Path) -> BinaryIO:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except FileExistsError as error:
        raise ConfigError(f"--out: {path} exists already, nothing is overwritten") from error
    except OSError as error:
        raise ConfigError(f"--out: {path}: cannot be created: {error.strerror}") from error
