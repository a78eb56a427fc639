"""`corridor drive`: a frozen network drives a robot: no learning, no memory, the image only (A45).

It acts greedily and turns on the spot where it predicts nothing good (`shared.rl.spot_turns`).
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.commander.commander import Commander, commanding
from shared.config import Config
from shared.facts import ACTIONS
from shared.messages import Motion, Observation, image_array
from shared.rl.draws import generator
from shared.rl.policy import choose_greedily
from shared.rl.predictor import Predictor
from shared.rl.spot_turns import Side, SpotTurns
from shared.service import TICK_S

ROLE = "drive"
TELL_EVERY_S = 2.0
Watch = Callable[[Observation, tuple[float, ...], int | None, str], None]
SILENT_S = 10.0
"""A robot that has said nothing for so long is mentioned."""


@dataclass(frozen=True)
class FrozenChoice:
    """What the network wants for one image."""

    action: int
    side: Side
    """Turn on the spot to this side instead; empty: drive."""
    values: tuple[float, ...]

    def __str__(self) -> str:
        what = f"turn {self.side}" if self.side else ACTIONS[self.action].name
        return f"{what:13} predicted " + " ".join(f"{value:+.2f}" for value in self.values)


class FrozenPolicy:
    """The frozen network and the turn it is in, if any.

    Args:
        network: Predicts; never changes.
        config: Seed (of draws between equal predictions), turn rate and period.
        robot: Id of the robot.
    """

    def __init__(self, network: Predictor, config: Config, robot: str) -> None:
        self._network = network
        self._turns = SpotTurns(config.robot.step_rad)
        self._draw = generator(config.run.seed, ROLE, robot)

    def choose(self, observation: Observation) -> FrozenChoice:
        """What to do about an observation."""
        values = self._network.all_values(image_array(observation.image)[np.newaxis])[0]
        action = choose_greedily(values, self._draw)
        side = self._turns.decide(values, action)
        return FrozenChoice(action, side, tuple(map(float, values)))


@dataclass
class DriveTally:
    """What the robot did so far, from its observations and what was asked of it."""

    actions: int = 0
    turns: int = 0
    bumps: int = 0
    way_m: float = 0.0
    _before: Observation | None = None
    _asked: bool = False

    def see(self, observation: Observation) -> None:
        """An observation that waits for an answer."""
        before, self._before = self._before, observation
        moved = self._asked and observation.interruption in ("", "moved")
        self._asked = False
        if before is None or (before.life, before.world) != (observation.life, observation.world):
            return
        if moved and observation.bump:
            self.bumps += 1
        if observation.sequence > before.sequence:
            self.actions += observation.sequence - before.sequence
        elif moved and observation.interruption == "moved":
            self.turns += 1
        self.way_m += math.hypot(observation.x_m - before.x_m, observation.y_m - before.y_m)

    def ask(self) -> None:
        """The observation was answered with an action or a turn."""
        self._asked = True

    def __str__(self) -> str:
        return (
            f"{self.actions} actions, {self.turns} turns on the spot, {self.bumps} bumps, "
            f"{self.way_m:.1f} m"
        )


def run(
    config: Config,
    predictor: Predictor,
    source: Path,
    robot: str | None,
    actions: int,
    echo: Callable[[str], None],
    watch: Watch | None = None,
) -> int:
    """Drive until stopped, or until the wanted number of actions is done.

    Args:
        config: How to reach the run, and its robot.
        predictor: The network.
        source: The file it comes from.
        robot: Which robot; None: the only one there is.
        actions: 0: until stopped.
        echo: Shows a line.
        watch: Gets each observation with the predictions, the action (None: a turn) and a text.

    Returns:
        The exit code.

    Raises:
        ConfigError: Another robot than there is.
        PeerMissing, RobotTaken or RouterMissing: See `commanding`.
    """
    with commanding(config, robot) as commander:
        echo(f"{commander.robot}: driven by {source}; Ctrl-C stops it")
        policy, tally = FrozenPolicy(predictor, config, commander.robot), DriveTally()
        try:
            _drive(commander, policy, tally, actions, echo, watch)
        finally:
            echo(f"{commander.robot}: {tally}")
    return 0


def _drive(
    commander: Commander,
    policy: FrozenPolicy,
    tally: DriveTally,
    actions: int,
    echo: Callable[[str], None],
    watch: Watch | None,
) -> None:
    now_s = time.monotonic()
    tell_s, silent_s = now_s, now_s + SILENT_S
    while not commander.stop.is_set() and not (actions and tally.actions >= actions):
        observation = commander.observe(TICK_S)
        now_s = time.monotonic()
        if observation is None:
            if now_s >= silent_s:
                silent_s = now_s + SILENT_S
                echo(f"{commander.robot}: nothing heard for {SILENT_S:.0f} s (stopped, paused?)")
            continue
        silent_s = now_s + SILENT_S
        tally.see(observation)
        if actions and tally.actions >= actions:
            return
        choice = policy.choose(observation)
        if choice.side:
            turn: Motion = "turn-left" if choice.side == "left" else "turn-right"
            commander.answer(observation, motion=turn, values=choice.values)
        else:
            commander.answer(observation, action=choice.action, values=choice.values)
        tally.ask()
        if watch:
            chosen = None if choice.side else choice.action
            watch(
                observation, choice.values, chosen, f"{tally.actions} actions, {tally.bumps} bumps"
            )
        if now_s >= tell_s:
            tell_s = now_s + TELL_EVERY_S
            echo(f"{choice}  {tally}")
