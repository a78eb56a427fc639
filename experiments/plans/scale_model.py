"""How much of an experiment a smaller scale keeps: numbers without a unit, beside full scale (E39).

A smaller experiment is a model of the large one where these numbers agree. Actions are counted in
memories: N actions renew a memory once.
"""

from experiments.plans.plan import Plan, full_plan, stage_config
from experiments.plans.scales import LEAST_CAPACITY, divisor_of, episode_actions, scaled
from shared.config import Config
from shared.rl.retention.rmm import RAISE_AT_MOST, RECOMPUTE_BELOW, scaled_count

TOLERANCE = 0.1
"""Numbers that differ by more than this part of the larger one are marked."""
Numbers = dict[str, float]
EPISODE = "actions of an episode / N"
STEPS = "gradient steps between equalisations"
LOST = {
    EPISODE: "an episode is as long at any scale: the horizon of the reward is 50 actions",
    STEPS: "as many epochs over a smaller memory are fewer steps",
}
"""Numbers that no smaller scale can keep, and why."""
SMALL_MEMORY = f"a memory holds at least {LEAST_CAPACITY} samples, one long episode"


def numbers(plan: Plan, index: int, length: float) -> Numbers:
    """The numbers of a stage; those of what the stage does not do are left out.

    length: Mean actions of an episode.
    """
    config = stage_config(plan, index, seed=1)
    memory, learning = config.memory, config.learning
    first = plan.stages[index - 1].until if index else 0
    each = length if plan.counted_in == "episodes" else 1.0
    fits = learning.fit_every_actions or learning.fit_every * length
    equalisations = memory.equalise_every_actions or memory.equalise_every * length
    found: Numbers = {
        "actions of the stage / N": (plan.stages[index].until - first) * each / memory.capacity,
        EPISODE: length / memory.capacity,
    }
    if fits:
        found["actions between fits / N"] = fits / memory.capacity
        found["epochs of a fit"] = learning.fit_epochs
    if equalisations:
        renewal = equalisations / memory.capacity
        found["actions between equalisations / N"] = renewal
        found["what is left of a reward after N actions"] = memory.equalise_keep ** (1.0 / renewal)
        found[STEPS] = _steps(config, equalisations, fits, length)
    if memory.strategy == "rmm":
        below = memory.recompute_below or scaled_count(RECOMPUTE_BELOW, memory.capacity)
        most = memory.raise_at_most or scaled_count(RAISE_AT_MOST, memory.capacity)
        found["candidates that are too few / N"] = below / memory.capacity
        found["candidates that raise the threshold / N"] = most / memory.capacity
    return found


def differing(full: Plan, scale: str) -> dict[str, dict[str, str]]:
    """Why numbers differ by more than 10 %, by stage and number; empty text for no reason."""
    plan, length = scaled(full, scale), episode_actions(full)
    found: dict[str, dict[str, str]] = {}
    for index, stage in enumerate(plan.stages):
        large, small = numbers(full, index, length), numbers(plan, index, length)
        config = stage_config(plan, index, seed=1)
        squeezed = config.memory.capacity == LEAST_CAPACITY
        found[stage.name] = {
            what: SMALL_MEMORY if squeezed else LOST.get(what, "")
            for what, there in large.items()
            if abs(small[what] - there) > TOLERANCE * max(small[what], there)
        }
    return found


def description(name: str, scale: str) -> str:
    """The numbers of a plan at full scale and at this one, as lines of text.

    Raises ConfigError for a plan or a scale that is not there.
    """
    full = full_plan(name)
    plan, length = scaled(full, scale), episode_actions(full)
    lines = [f"{plan.title} ({plan.source})"]
    if divisor_of(full, scale) == 1 or not plan.stages:
        return f"{lines[0]}\nas large at this scale as at full scale"
    lines.append(f"episodes of {length:.0f} actions on average")
    reasons = differing(full, scale)
    for index, stage in enumerate(plan.stages):
        large, small = numbers(full, index, length), numbers(plan, index, length)
        lines.append(f"\n{stage.name:42}{'full':>10}{scale:>12}")
        for what, there in large.items():
            why = reasons[stage.name].get(what)
            mark = "" if why is None else f"  differs: {why}"
            lines.append(f"  {what:40}{there:10.3g}{small[what]:12.3g}{mark}")
    return "\n".join(lines)


def _steps(config: Config, actions: float, fits: float, length: float) -> float:
    """Gradient steps of this many actions, on average.

    fits: Actions between fitting phases; 0: there are none. length: Mean actions of an episode.
    """
    learning = config.learning
    steps = learning.mini_batches_per_episode / length
    if fits:
        batches = -(-config.memory.capacity // learning.batch_size)
        steps += learning.fit_epochs * batches / fits
    return steps * actions
