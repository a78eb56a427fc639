"""The last seconds of a run in memory, so that they can be written after something happened."""

from __future__ import annotations

from collections import deque

from services.recorder.recording import RecordingWriter
from services.recorder.tap import Heard

MAX_BYTES = 256 * 1024 * 1024
"""Of messages, and of weights: what is older goes first, and is counted."""


class Ring:
    """Takes what a recording takes, and forgets what is older than so many seconds.

    The newest two versions of the weights from before that time stay: actions may come from them.
    """

    def __init__(self, last_s: float) -> None:
        self._last_ns = int(last_s * 1e9)
        self._messages: deque[Heard] = deque()
        self._weights: deque[tuple[int, bytes, int]] = deque()
        self.size = self._weight_bytes = 0
        """Bytes of messages, and of weights."""
        self.messages = self.refused = 0
        """Messages kept, and those that went before their time: there is no room."""

    def add(self, heard: Heard) -> None:
        """Keep a message."""
        self._messages.append(heard)
        self.size += len(heard.data)
        start_ns = heard.time_ns - self._last_ns
        while self._messages[0].time_ns < start_ns or self.size > MAX_BYTES:
            gone = self._messages.popleft()
            self.size -= len(gone.data)
            self.refused += gone.time_ns >= start_ns
        while len(self._weights) > 2 and self._weights[2][2] < start_ns:
            self._forget()
        self.messages = len(self._messages)

    def add_weights(self, version: int, data: bytes, time_ns: int) -> None:
        """Keep a version of the target network."""
        self._weights.append((version, data, time_ns))
        self._weight_bytes += len(data)
        while self._weight_bytes > MAX_BYTES:
            self._forget()

    def write(self, writer: RecordingWriter) -> None:
        """Write all that is kept; it stays."""
        for version, data, time_ns in self._weights:
            writer.add_weights(version, data, time_ns)
        for heard in self._messages:
            writer.add(heard)

    def flush(self) -> None:
        """Nothing: memory needs none."""

    def _forget(self) -> None:
        self._weight_bytes -= len(self._weights.popleft()[1])
