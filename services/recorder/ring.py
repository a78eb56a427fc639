"""The last seconds of a run in memory, so that they can be written after something happened."""

from collections import deque

from services.recorder.recording import RecordingWriter
from services.recorder.tap import Heard, Version

MAX_BYTES = 512 * 1024 * 1024
"""What is older goes first, and is counted."""


class Ring:
    """Takes what a recording takes, and forgets what is older than so many seconds.

    The newest two versions of the weights from before that time stay: actions may come from them.
    """

    def __init__(self, last_s: float) -> None:
        self._last_ns = int(last_s * 1e9)
        self._kept: deque[Heard | Version] = deque()
        self._weights: deque[Version] = deque(maxlen=2)
        self.size = self.refused = 0
        """Bytes; messages that went before their time, because there was no room."""

    @property
    def messages(self) -> int:
        """How many are kept."""
        return sum(isinstance(each, Heard) for each in self._kept)

    def add(self, new: Heard | Version) -> None:
        """Keep a message, or a version of the target network."""
        self._kept.append(new)
        self.size += len(new.data)
        start_ns = new.time_ns - self._last_ns
        while self._kept[0].time_ns < start_ns or self.size > MAX_BYTES:
            gone = self._kept.popleft()
            self.size -= len(gone.data)
            if isinstance(gone, Version):
                self._weights.append(gone)
            else:
                self.refused += gone.time_ns >= start_ns

    def write(self, writer: RecordingWriter) -> None:
        """Write all that is kept; it stays."""
        for each in (*self._weights, *self._kept):
            writer.add(each)

    def flush(self) -> None:
        """Nothing: memory needs none."""
