"""Whatever happens to robots and actors, replay never refuses what a correct actor sends."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from builders import FakePredictor, make_config, make_observation
from hypothesis import given, settings
from hypothesis import strategies as st

from services.actor.actor import Actor
from services.replay.numbering import progress_of
from services.replay.storage import Storage
from shared.messages import Episode, Observation

SLOW_DISK = settings(deadline=None, max_examples=60, derandomize=True)
EVENTS = (
    *["go"] * 12,
    *("bump", "late", "contact before the answer", "moved", "blocked with a bump"),
    *(
        "answer lost",
        "driver killed",
        "driver stopped",
        "actor killed",
        "actor stopped",
        "acknowledgement lost",
    ),
    *("new weights", "replay killed"),
)


class Replay:
    """The storage, and the numbers that its acknowledgements bring."""

    def __init__(self, folder: Path, config: Any) -> None:
        self._folder, self._config = folder, config
        self.storage = Storage(folder, config, "run/1")
        self.taken: list[Episode] = []

    def reopen(self) -> None:
        self.storage.close()
        self.storage = Storage(self._folder, self._config, "run/1")

    def commit(self, episode: Episode, *, twice: bool) -> None:
        assert not self.storage.commit(episode).duplicate
        self.taken.append(episode)
        if twice:
            assert self.storage.commit(episode).duplicate

    def progress(self, robot: str) -> Any:
        return progress_of(self.storage.counters(), self._config, robot)


class Robot:
    """A driver's numbering, and the actor of its robot with its restarts."""

    def __init__(self, name: str, config: Any, replay: Replay) -> None:
        self.name, self.config, self.replay = name, config, replay
        self.predictor, self.lives = FakePredictor(), 0
        self.life, self.sequence, self.attempt = self.new_life(), 0, 0
        self.earlier: tuple[str, ...] = ()
        self.executed: tuple[int | None, str] = (None, "")
        self.seen: dict[str, Any] = {}
        self.twice = False
        self.actor = self.new_actor()
        self.look()

    def new_life(self) -> str:
        self.lives += 1
        return f"{self.lives:011x}{self.name[-1]}"

    def new_actor(self, saved: dict[str, Any] | None = None) -> Actor:
        made: Any = Actor(self.config, self.name, self.new_life(), self.predictor)  # type: ignore[arg-type]
        if saved is not None:
            made.restore(saved)
        made.begin(self.replay.progress(self.name), self.observation())
        return made  # type: ignore[no-any-return]

    def observation(self) -> Observation:
        action, actor_life = self.executed
        plain: dict[str, Any] = {"robot": self.name, "life": self.life, "attempt": self.attempt}
        plain |= {"earlier": self.earlier, "action": action, "actor_life": actor_life}
        return make_observation(self.sequence, **plain, **self.seen)

    def look(self) -> None:
        """What the session does about a new observation, up to the answer."""
        observation = self.observation()
        episode = self.actor.finish(observation)
        if episode is not None:
            self.replay.commit(episode, twice=self.twice)
            self.actor.committed(self.replay.progress(self.name))
        action = self.actor.act(observation)
        self.answer = (action.action, action.actor_life)

    def happen(self, event: str) -> None:
        self.seen, self.twice = {}, event == "acknowledgement lost"
        if event == "new weights":
            self.predictor.version += 1
        if event == "actor killed":
            self.actor = self.new_actor()
        elif event == "actor stopped":
            self.actor = self.new_actor(msgpack.unpackb(msgpack.packb(self.actor.state())))
        elif event == "driver killed":
            self.life, self.sequence, self.attempt = self.new_life(), 0, 0
            self.earlier, self.executed = (), (None, "")
        elif event == "driver stopped":
            self.earlier, self.life = (self.life, *self.earlier)[:8], self.new_life()
        elif event in ("late", "moved", "contact before the answer"):
            self.attempt += 1
            bump = event.startswith("contact")
            self.seen = {"bump": bump, "interruption": "" if bump else event}
        elif event == "answer lost":
            self.attempt += 1
        else:
            self.sequence, self.attempt, self.executed = self.sequence + 1, 0, self.answer
            bump = event in ("bump", "blocked with a bump")
            self.seen = {"bump": bump}
            if event.startswith("blocked"):
                self.attempt, self.seen["interruption"] = 1, "blocked"
        self.look()


def sequences(episode: Episode) -> list[int]:
    images = np.frombuffer(episode.images, np.uint8).reshape(-1, 3750)[:, :4]
    return [int.from_bytes(image.tobytes(), "little") for image in images]


@pytest.mark.parametrize("fill", ["random", "none"])
@SLOW_DISK
@given(
    happened=st.lists(
        st.tuples(st.integers(0, 1), st.sampled_from(EVENTS)), min_size=30, max_size=140
    )
)
def test_what_a_correct_actor_sends_is_stored_once_and_never_refused(
    fill: str, happened: list[tuple[int, str]]
) -> None:
    config = make_config(
        episode={"max_samples": 12, "horizon": 4}, memory={"capacity": 30, "fill": fill}
    )
    with tempfile.TemporaryDirectory() as folder:
        replay = Replay(Path(folder), config.memory)
        robots = [Robot(f"robot{n}", config, replay) for n in range(2)]
        for which, event in happened:
            if event == "replay killed":
                replay.reopen()
            robots[which].happen(event)
        replay.storage.close()
    stored = [(e.robot, e.robot_life, s) for e in replay.taken for s in sequences(e)]
    assert len(stored) == len(set(stored))
    assert sum(robot.actor.foreign_actions for robot in robots) == 0
    for episode in replay.taken:
        assert max(sequences(episode)) <= episode.last_sequence
