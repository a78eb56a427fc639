"""The one decision of an actor: values in, action out. A function of what its message tells."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shared.facts import Chooser
from shared.rl.draws import generator
from shared.rl.policy import Values, choose, choose_uniformly

if TYPE_CHECKING:
    from shared.config import Config


def decide(
    config: Config, robot: str, values: Values, *, filling: bool, episode: int, step: int
) -> tuple[int, Chooser]:
    """Choose an action (A13, A18-A20, E9).

    Args:
        config: Seed, policy, and how the memory is filled.
        robot: Id of the robot.
        values: Clipped Q of all actions, float32 [actions].
        filling: The memory is still being filled.
        episode: Fill submissions of the robot so far while filling, else its counted episodes.
        step: Steps in its open episode so far.

    Returns:
        The number of the action, and who chose it: the network by the greedy branch, or chance.
    """
    role = "fill" if filling else "policy"
    draw = generator(config.run.seed, role, robot, episode, step)
    if filling and config.memory.fill == "random":
        return choose_uniformly(draw), "chance"
    action, greedy = choose(values, config.policy, draw)
    return action, "network" if greedy else "chance"
