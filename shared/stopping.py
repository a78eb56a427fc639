"""How a service comes to its end: it is asked to stop, or one of its threads fails."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stopped(Exception):
    """The service was asked to stop while it waited: unwinds to its main function."""


class StopFlag:
    """Set by SIGTERM, SIGINT, a `stop` command or the end of the run; remembers why."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self.reason = ""
        self._wakes: list[Callable[[], None]] = []

    def set(self, reason: str) -> None:
        """Ask the service to stop."""
        if not self._event.is_set():
            self.reason = reason
            self._event.set()
            for wake in self._wakes:
                wake()

    def is_set(self) -> bool:
        """Whether the service is to stop."""
        return self._event.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Sleep for at most `timeout_s`; True as soon as the service is to stop."""
        return self._event.wait(timeout_s)

    def on_set(self, wake: Callable[[], None]) -> None:
        """Call `wake` when set (to interrupt a wait)."""
        self._wakes.append(wake)


@contextmanager
def failing_together(stop: StopFlag) -> Iterator[None]:
    """Let the error of any thread end the service, which then fails with it.

    One of TensorBoard ends nothing: its thread tells its error to whoever writes.
    """
    before, failures = threading.excepthook, list[BaseException]()

    def on_failure(args: threading.ExceptHookArgs) -> None:
        error, thread = args.exc_value, args.thread
        ours = not type(thread).__module__.startswith("tensorboard")
        if error is not None and ours and not isinstance(error, Stopped):
            failures.append(error)
            stop.set(f"thread {thread.name if thread else None!r} ended: {error!r}")

    threading.excepthook = on_failure
    try:
        yield
    except Stopped:
        if not failures:
            raise
    finally:
        threading.excepthook = before
    if failures:
        raise failures[0]
