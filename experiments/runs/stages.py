"""Puts a stage of a plan into effect: configuration, world, retention and capacity of the loop."""

from experiments.plans.plan import Plan, Stage, merged
from experiments.runs.totals import Totals
from experiments.single_process import SingleProcess
from shared.config import Config
from shared.errors import ConfigError
from shared.messages import WorldChange
from shared.rl.retention.rmm import force_candidates
from shared.rl.retention.strategy import begin


def enter(loop: SingleProcess, plan: Plan, stage: Stage, config: Config, *, first: bool) -> None:
    """Let the loop go on in a stage, between two turns; `first`: the run begins with it.

    Raises ConfigError when the driver refuses a change of the world.
    """
    before = loop.config
    loop.reconfigure(config)
    if config.robot.world != loop.env.robot.world.name:
        episode = loop.counters.episode
        switch = WorldChange(kind="switch", world=config.robot.world, at_episode=episode)
        _change(loop, plan, switch)
    if stage.force_candidates:
        force_candidates(loop.memory, loop.memory.ids)
    # Both change on the way: a stage sets them where it says something new.
    named = merged(plan.config, stage.config).get("memory", {})
    known, wanted = begin(before.memory), begin(config.memory)
    loop.memory.kept |= {  # a first stage that names none keeps it (E45)
        key: value
        for key, value in wanted.items()
        if (key in named if first else known[key] != value)
    }
    if first or before.memory.capacity != config.memory.capacity:
        loop.memory.set_capacity(config.memory.capacity)


def change_world(loop: SingleProcess, plan: Plan, stage: Stage, totals: Totals) -> None:
    """Tell the driver of what is due in the next episode. Raises ConfigError when it refuses."""
    following = totals.done(loop, plan.counted_in) + 1
    for change in stage.changes[totals.changes :]:
        if change["at"] > following:
            break
        wish = {key: value for key, value in change.items() if key != "at"}
        wish["at_episode"] = loop.counters.episode + 1
        _change(loop, plan, WorldChange.model_validate(wish))
        totals.changes += 1


def _change(loop: SingleProcess, plan: Plan, wish: WorldChange) -> None:
    """Let the driver change the world. Raises ConfigError when it refuses."""
    answer = loop.env.driver.change(wish)
    if not answer.accepted:
        raise ConfigError(f"plan {plan.name}: {wish.kind}: {answer.reason}")
