"""A transfer ends when it stands still, and only then; an error of a thread ends its service."""

from __future__ import annotations

import threading
from contextlib import suppress

import pytest

from benchmarks.waiting import wait_until
from shared.bus import Bus
from shared.config import BusConfig
from shared.errors import PeerMissing
from shared.keys import SNAPSHOT
from shared.messages import NO_LINEAGE, FeedEnd, SnapshotRequest
from shared.threads import StopFlag, Stopped, failing_together, jittered, paced


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


def test_a_peer_that_stops_in_the_middle_is_not_waited_for(router: str, run_name: str) -> None:
    end = FeedEnd(change=1, rows=0, messages=0, lineage=NO_LINEAGE)
    config = BusConfig(endpoint=router)
    with Bus(config, run_name) as replay, Bus(config, run_name) as learner:
        inbox = replay.inbox()
        inbox.serve(SNAPSHOT)
        received: list[FeedEnd] = []

        def ask() -> None:
            while not received:
                with suppress(PeerMissing):  # the router does not know of it yet
                    given = learner.request_many(
                        SNAPSHOT, SnapshotRequest(), FeedEnd, patience_s=0.3
                    )
                    received.extend(given)

        asking = threading.Thread(target=ask)
        asking.start()
        (request,) = wait_until(lambda: list(inbox.requests()), 20, "a request")
        with request:
            request.reply(end)
            asking.join(20)  # without an error: the caller sees that something is missing
            assert received == [end]
            request.reply(end)  # and whoever goes on sending is not disturbed
