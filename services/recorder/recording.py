"""The form of a recording, an MCAP file, and a writer of it (docs/recording.md has a table of it).

Chunks are compressed by zstd and end once a second, so that a kill costs no more than that.
"""

import json
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO, Self

from foxglove import Schema
from mcap.writer import Writer

from services.recorder.tap import Heard, Version
from services.recorder.views import Solids, View, Views
from shared.codec import decode
from shared.config import Config, Numerics
from shared.errors import BadMessage, ConfigError
from shared.keys import ACTION, OBSERVATION, STREAMS, Stream
from shared.messages import PROTOCOL_VERSION
from shared.rl.preprocess import PREPROCESS_VERSION
from shared.settings import to_toml

PROFILE, ENCODING, SCHEMA_ENCODING = "corridor", "msgpack", "jsonschema"
RECORDING, CONFIG, SUMMARY, WEIGHTS = "recording", "config", "summary", "weights/"
CHUNK_BYTES = 1024 * 1024
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
        solids: What stands in its worlds.

    Raises:
        ConfigError: The file exists or cannot be made.
    """

    def __init__(self, path: Path, origin: Origin, solids: Solids = lambda _: ()) -> None:
        self.messages = self.refused = 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._views = Views(solids)
        self._run = origin.config.run.name
        self._file = _create(path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
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

    def add(self, new: Heard | Version) -> None:
        """Write a version of the target network, or a message and what other tools show of it."""
        if isinstance(new, Version):
            name, media_type = f"{WEIGHTS}{new.number}", "application/octet-stream"
            self._writer.add_attachment(new.time_ns, new.time_ns, name, media_type, new.data)
            return
        stream = new.stream
        raw = View(stream.key(self._run, new.ident), _schema(stream), new.data, ENCODING)
        if not self._write(raw, new.time_ns):
            self.refused += 1
            return
        self.messages += 1
        if stream in (OBSERVATION, ACTION):
            with suppress(BadMessage):  # playback counts it
                for view in self._views.of(decode(new.data, stream.request), new.time_ns):
                    self._write(view, new.time_ns)

    def add_summary(self, counts: dict[str, int]) -> None:
        """Write how much there is, and how much was lost."""
        self._writer.add_metadata(SUMMARY, {name: str(count) for name, count in counts.items()})

    def flush(self) -> None:
        """Hand everything so far to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def _write(self, view: View, time_ns: int) -> bool:
        """Write a message of any channel; False: there are too many channels."""
        name, topic = view.schema.name, view.topic
        if topic not in self._channels:
            if len(self._channels) >= MAX_CHANNELS:
                return False
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(
                    name, view.schema.encoding, view.schema.data
                )
            self._channels[topic] = self._writer.register_channel(
                topic, view.encoding, self._schemas[name]
            )
        self._writer.add_message(
            self._channels[topic], time_ns, view.data, time_ns, sequence=self.messages % 2**32
        )
        return True


@cache
def _schema(stream: Stream) -> Schema:
    message = stream.request
    fields = json.dumps(message.model_json_schema()).encode()
    return Schema(name=message.__name__, encoding=SCHEMA_ENCODING, data=fields)


def _create(path: Path) -> BinaryIO:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except FileExistsError as error:
        raise ConfigError(f"--out: {path} exists already, nothing is overwritten") from error
    except OSError as error:
        raise ConfigError(f"--out: {path}: cannot be created: {error.strerror}") from error
