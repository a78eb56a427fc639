"""Threads of a service: asked to stop, failing together, waiting not all at once, and for long."""

import random
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
LONGEST_S = 86_400.0
"""Time for a transfer that goes on."""


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


def jittered(wait_s: float) -> float:
    """Some time up to this, so that those who wait for the same do not come all at once."""
    return wait_s * random.uniform(0.5, 1.0)  # noqa: S311


def paced(items: Iterable[T], patience_s: float, give_up: Callable[[], None]) -> Iterator[T]:
    """Yield items as they come. If none came for so long, a thread calls what ends `items`."""
    moved, ended = threading.Event(), False

    def watch() -> None:
        while moved.wait(patience_s) and not ended:
            moved.clear()
        if not ended:
            give_up()

    threading.Thread(target=watch, name="pacing", daemon=True).start()
    try:
        for item in items:
            moved.set()
            yield item
    finally:
        ended = True
        moved.set()


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C, SIGTERM and, but for nohup, a closed terminal set in the block."""
    stop = threading.Event()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
