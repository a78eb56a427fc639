"""What is seen of a robot: trail, bumps, and how soon observations are answered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest
from builders import LIFE, OTHER_LIFE, make_observation

from services.page import watch
from services.page.track import BUMPS, STEP_M, TRAIL, WAITING, Track
from shared.bus import Bus as RealBus
from shared.codec import encode
from shared.keys import ACTION, OBSERVATION, Stream
from shared.messages import Action


def make_action(sequence: int, **given: Any) -> Action:
    plain: dict[str, Any] = {
        "robot": "robot1", "actor_life": OTHER_LIFE, "robot_life": LIFE, "sequence": sequence,
        "action": 1, "by": "network", "values": (0.1, 0.4, -0.2), "weights_version": 3,
    }  # fmt: skip
    return Action(**{**plain, **given})


def test_nothing_is_shown_of_what_nobody_saw() -> None:
    assert Track().shown() == {"latency_ms": ()}


def test_the_newest_image_is_shown_with_predictions_and_choice() -> None:
    track = Track()
    track.observe(make_observation(7, x_m=1.0, y_m=2.0, heading_rad=0.5), 10.0)
    track.act(make_action(7), 10.02)
    shown = track.shown()
    assert (shown["action"], shown["values"]) == (1, (0.1, 0.4, -0.2))
    assert shown["pose"] == [1.0, 2.0, 0.5]
    assert len(shown["image"]) == 5000


def test_delays_are_those_of_answers_to_what_was_seen() -> None:
    track = Track()
    for sequence in range(100):
        track.observe(make_observation(sequence), float(sequence))
        track.observe(
            make_observation(sequence), sequence + 0.5
        )  # sent again: the first one counts
        track.act(make_action(sequence), sequence + 0.001 * (sequence + 1))
        track.act(make_action(sequence), sequence + 0.9)  # nobody waits for it any more
    track.act(make_action(5, robot_life=OTHER_LIFE), 200.0)
    assert track.latency_ms() == (pytest.approx(50.5), pytest.approx(95.05))


def test_bumps_and_trail_are_bounded_and_end_with_the_world() -> None:
    track = Track()
    for sequence in range(3 * TRAIL):
        bump = sequence % 2 == 1
        seen = make_observation(sequence, x_m=STEP_M * 1.01 * sequence, bump=bump)
        track.observe(seen, 0.0)
        track.observe(seen, 0.0)
    assert (len(track.trail), len(track.bumps)) == (TRAIL, BUMPS)
    assert len(track._waiting) == WAITING
    assert track.bumps[-1] == track.trail[-2]  # where it drove into something, not where it is now
    track.observe(make_observation(5000, world="minus"), 0.0)
    assert (list(track.trail), list(track.bumps)) == ([(0.0, 0.0)], [])


def test_a_robot_that_stands_leaves_no_trail() -> None:
    track = Track()
    for sequence in range(10):
        track.observe(make_observation(sequence, x_m=0.001 * sequence), 0.0)
    assert len(track.trail) == 1
    track.observe(make_observation(10, x_m=5.0), 0.0)
    assert list(track.trail)[1:] == [None, (5.0, 0.0)]  # nobody saw the way there


class Bus:
    """Hands what is published to whoever listens."""

    def __init__(self) -> None:
        self.keepers: dict[Stream, Callable[[str | None, bytes], None]] = {}

    def subscribe(
        self, stream: Stream, ident: str, keep: Callable[[str | None, bytes], None]
    ) -> None:
        self.keepers[stream] = keep


def test_messages_wait_in_bounded_queues_and_losses_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watch, "KEPT", 4)
    monkeypatch.setattr(watch, "MAX_SENDERS", 1)
    bus, tracks = Bus(), dict[str, Track]()
    stamped = watch.Stamped(cast(RealBus, bus))
    for sequence in range(3):
        bus.keepers[OBSERVATION]("robot1", encode(make_observation(sequence)))
        bus.keepers[ACTION]("robot1", encode(make_action(sequence)))
    bus.keepers[OBSERVATION]("robot2", encode(make_observation(1, robot="robot2")))
    bus.keepers[OBSERVATION](None, b"")
    assert stamped.lost == 4  # two of six, one too many robots, one of nobody
    stamped.into(tracks)
    assert (len(tracks["robot1"].delays_ms), list(tracks)) == (2, ["robot1"])
    bus.keepers[ACTION]("robot1", encode(make_action(3, robot="robot2")))
    bus.keepers[ACTION]("robot1", b"junk")
    stamped.into(tracks)
    assert stamped.lost == 6
