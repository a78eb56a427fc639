"""What robots share at the actor: target networks by version, and the way to replay."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from services.actor.courier import Courier
from services.actor.targets import Targets
from shared.config import ActorNumerics, NetworkConfig
from shared.errors import PeerSilent
from shared.messages import EpisodeAck
from shared.rl.network import initialised, to_bytes

SMALL = NetworkConfig(filters=4)
PATIENCE_S = 20.0


def weights(seed: int) -> bytes:
    return to_bytes(initialised(SMALL, seed))


def test_robots_on_one_version_share_a_predictor_until_none_needs_it() -> None:
    targets, images = Targets(SMALL, ActorNumerics()), np.zeros((1, 50, 75), np.uint8)
    assert targets.none.version == 0
    first, again, second = (targets.of(v, weights(v)) for v in (1, 1, 2))
    assert first is again
    assert (first.version, second.version) == (1, 2)
    assert not np.array_equal(first.all_values(images), second.all_values(images))
    assert targets.none.version == 0
    del first, again
    gc.collect()
    assert list(targets._in_use) == [2]


class Replay:
    """Answers at once, after some silences, or not until it is let."""

    def __init__(self, silences: int = 0) -> None:
        self.silences, self.let = silences, threading.Event()

    def request(self, stream: Any, episode: Any, cls: Any, *, ident: str) -> EpisodeAck:
        if self.silences:
            self.silences -= 1
            raise PeerSilent("silent")
        if episode.robot == "held-up":
            assert self.let.wait(PATIENCE_S)
        return EpisodeAck(accepted=True)


def of(robot: str) -> Any:
    """An episode of a robot."""
    return SimpleNamespace(robot=robot)


def courier(replay: Replay, notify: Callable[[], None]) -> Courier:
    def insist(_: str, attempt: Callable[[], Any], **__: Any) -> Any:
        while True:
            try:
                return attempt()
            except PeerSilent:
                continue

    return Courier(SimpleNamespace(bus=replay, insist=insist), notify)  # type: ignore[arg-type]


def test_an_episode_that_is_held_up_holds_up_no_other() -> None:
    replay, told = Replay(), threading.Semaphore(0)
    sender = courier(replay, told.release)
    slow, quick = sender.send(of("held-up")), sender.send(of("any"))
    assert quick.result(PATIENCE_S).ack.accepted
    assert told.acquire(timeout=PATIENCE_S)
    assert not slow.done()
    replay.let.set()
    assert slow.result(PATIENCE_S).attempts == 1
    assert told.acquire(timeout=PATIENCE_S)


def test_attempts_are_counted_and_failures_arrive() -> None:
    sender = courier(Replay(silences=2), lambda: None)
    assert sender.send(of("any")).result(PATIENCE_S).attempts == 3

    def stopped(_: str, attempt: Callable[[], Any], **__: Any) -> Any:
        raise RuntimeError("stopped")

    sender = Courier(SimpleNamespace(bus=None, insist=stopped), lambda: None)  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match="stopped"):
        sender.send(of("any")).result(PATIENCE_S)
