"""How much of an experiment a smaller scale keeps: numbers without a unit, beside full scale (E39).

A smaller experiment is a model of the large one where these numbers agree. Actions are counted in
memories: N actions renew a memory once.
"""

from __future__ import annotations

from experiments.plans.plan import Plan, Scale, load_plan, stage_config
from shared.config import Config
from shared.rl.retention.rmm import RAISE_AT_MOST, RECOMPUTE_BELOW, scaled_count

TOLERANCE = 0.1
"""Numbers that differ by more than this part of the larger one are marked."""
Numbers = dict[str, float]


def numbers(plan: Plan, index: int, episode_actions: float) -> Numbers:
    """The numbers of a stage; those of what the stage does not do are left out.

    Args:
        plan: The plan at its scale.
        index: Which of its stages.
        episode_actions: Mean length of an episode.
    """
    config = stage_config(plan, index, seed=1)
    stage = plan.stages[index]
    first = plan.stages[index - 1].until if index else 0
    memory, learning = config.memory, config.learning
    found: Numbers = {
        "actions of the stage / N": (stage.until - first) * episode_actions / memory.capacity,
        "actions of an episode / N": episode_actions / memory.capacity,
    }
    if learning.fit_every:
        found["actions between fits / N"] = learning.fit_every * episode_actions / memory.capacity
        found["epochs of a fit"] = learning.fit_epochs
    if memory.equalise_every:
        renewal = memory.equalise_every * episode_actions / memory.capacity
        found["actions between equalisations / N"] = renewal
        found["what is left of a reward after N actions"] = memory.equalise_keep ** (1.0 / renewal)
        found["gradient steps between equalisations"] = _steps(config, memory.equalise_every)
    if memory.strategy == "rmm":
        below = memory.recompute_below or scaled_count(RECOMPUTE_BELOW, memory.capacity)
        most = memory.raise_at_most or scaled_count(RAISE_AT_MOST, memory.capacity)
        found["candidates that are too few / N"] = below / memory.capacity
        found["candidates that raise the threshold / N"] = most / memory.capacity
    return found


def description(name: str, scale: Scale) -> str:
    """The numbers of a plan at full scale and at this one, as lines of text.

    Raises ConfigError for a plan that is not there.
    """
    full, plan = load_plan(name, "full"), load_plan(name, scale)
    lines = [f"{plan.title} ({plan.source})"]
    if "actions" not in full.thesis:
        return f"{lines[0]}\nthe thesis tells no number of actions, so nothing can be compared"
    length = full.thesis["actions"] / full.thesis["episodes"]
    lines.append(f"episodes of {length:.0f} actions, as in the thesis")
    for index, stage in enumerate(plan.stages):
        large, small = numbers(full, index, length), numbers(plan, index, length)
        lines.append(f"\n{stage.name:44}{'full':>10}{scale:>10}")
        for what, there in large.items():
            here = small[what]
            mark = "" if abs(here - there) <= TOLERANCE * max(here, there) else "  differs"
            lines.append(f"  {what:42}{there:10.3g}{here:10.3g}{mark}")
    return "\n".join(lines)


def _steps(config: Config, episodes: int) -> float:
    """Gradient steps of this many episodes, on average."""
    learning = config.learning
    steps = float(learning.mini_batches_per_episode)
    if learning.fit_every:
        batches = -(-config.memory.capacity // learning.batch_size)
        steps += (learning.fit_epochs * batches - steps) / learning.fit_every
    return steps * episodes
