"""A transfer ends when it stands still, and only then; an error of a thread ends its service."""

from __future__ import annotations

import threading

import pytest

from shared.pacing import jittered, paced
from shared.stopping import StopFlag, Stopped, failing_together


class Feed:
    """Gives items as a test lets them come, until it is given up."""

    def __init__(self, items: int) -> None:
        self.items, self.given_up = items, threading.Event()

    def __iter__(self) -> Feed:
        return self

    def __next__(self) -> int:
        if not self.items:
            assert self.given_up.wait(20)
            raise StopIteration
        self.items -= 1
        return self.items


def test_what_stands_still_is_given_up_and_what_goes_on_is_not() -> None:
    feed = Feed(3)
    assert list(paced(feed, 0.05, feed.given_up.set)) == [2, 1, 0]
    ending = Feed(3)
    assert list(paced(iter([1, 2]), 0.05, ending.given_up.set)) == [1, 2]
    watching = [t for t in threading.enumerate() if t.name == "pacing"]
    for thread in watching:
        thread.join(20)
    assert not ending.given_up.is_set()


def test_waits_differ_and_are_no_longer_than_told() -> None:
    waits = {jittered(2.0) for _ in range(50)}
    assert len(waits) > 25
    assert 1.0 <= min(waits) <= max(waits) <= 2.0


@pytest.mark.parametrize("main", ["runs", "waits"])
def test_an_error_of_a_thread_ends_the_service_which_fails_with_it(main: str) -> None:
    stop, before = StopFlag(), threading.excepthook

    def fail() -> None:
        raise LookupError("weights: unexpected")

    def run() -> None:
        with failing_together(stop):
            threading.Thread(target=fail, name="weights").start()
            assert stop.wait(20)
            if main == "waits":
                raise Stopped("waiting for weights")

    with pytest.raises(LookupError, match="unexpected"):
        run()
    assert "'weights' ended: LookupError" in stop.reason
    assert threading.excepthook is before


def test_a_thread_that_was_told_to_stop_is_no_failure() -> None:
    stop = StopFlag()

    def ends() -> None:
        raise Stopped("a pass over the memory")

    with failing_together(stop):
        thread = threading.Thread(target=ends)
        thread.start()
        thread.join()
    assert not stop.is_set()
