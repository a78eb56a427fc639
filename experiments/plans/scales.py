"""Scales: a plan with smaller memories, so that it takes minutes instead of days (E39).

A small scale divides by one number: the memory, and every number of actions. What the thesis counts
in episodes is counted in actions there, since the length of episodes depends on who learns. So a
memory is renewed, equalised and learnt from as often as in the thesis.
"""

from importlib.resources.abc import Traversable
from typing import NamedTuple

from experiments.plans.plan import PLANS, Plan, Stage, Tree, check, full_plan, merged
from shared.config import Config
from shared.errors import ConfigError, not_among
from shared.settings import preset_tree


class Scale(NamedTuple):
    """What a scale makes of a plan."""

    divisor: int
    """What memories and numbers of actions are divided by."""
    narrow: bool
    """Whether the network has 16 filters instead of 64."""


SCALES = {
    "full": Scale(1, narrow=False),
    "fifth": Scale(5, narrow=True),
    "fifth-wide": Scale(5, narrow=False),
    "tenth": Scale(10, narrow=True),
    "tenth-wide": Scale(10, narrow=False),
    "forty-fifth": Scale(45, narrow=True),
}
LEAST_CAPACITY = 500
"""No memory gets smaller: it is as large as the longest episode, which is as long at any scale."""
NARROW: Tree = {
    "network": {"filters": 16, "layout": "cpcccp"},
    # It takes a third less time a step in parts of this size. bfloat16 would gain little more, and
    # not on every processor.
    "numerics": {"learner": {"precision": "float32", "batch": 16}},
}
"""The narrow network, and arithmetic that suits it. Otherwise all plans compute as the demo does,
measured where they run."""
UNKNOWN_LENGTH = "smaller scales count actions: expected episode_actions, or fixed_size = true"
_SIZES = ("capacity", "capacity_max", "capacity_step")
_PERIODS = (("memory", "equalise_every"), ("learning", "fit_every"))


def load_plan(name: str, scale: str, folder: Traversable = PLANS) -> Plan:
    """The plan of this name at a scale. Raises ConfigError: there is none, or its file is wrong."""
    return scaled(full_plan(name, folder), scale)


def divisor_of(plan: Plan, scale: str) -> int:
    """How many times smaller a scale makes a plan."""
    return 1 if plan.fixed_size else SCALES[scale].divisor


def scaled(plan: Plan, scale: str) -> Plan:
    """A plan at a scale. Raises ConfigError."""
    if scale not in SCALES:
        raise not_among("--scale", scale, SCALES)
    divisor = divisor_of(plan, scale)
    if divisor > 1 and plan.stages:
        plan = _smaller(plan, divisor)
    config = merged({"numerics": preset_tree("demo")["numerics"]}, plan.config)
    if SCALES[scale].narrow:
        config = merged(config, NARROW)
    if scale != "full":
        config = merged(config, plan.small)
    plan = plan.model_copy(update={"config": config})
    check(plan)
    return plan


def episode_actions(plan: Plan) -> float:
    """Mean length of an episode: that of the plan, or that of the thesis; 0 if neither is known."""
    told = plan.thesis.get("actions", 0.0) / plan.thesis.get("episodes", 1.0)
    return plan.episode_actions or told


def _smaller(plan: Plan, divisor: int) -> Plan:
    """The plan with its numbers divided, and with actions counted."""
    length = episode_actions(plan)
    if not length and plan.counted_in == "episodes":
        raise ConfigError(f"plan {plan.name}: {UNKNOWN_LENGTH}")
    factor = (length if plan.counted_in == "episodes" else 1.0) / divisor
    stages = tuple(
        stage.model_copy(
            update={
                "until": _rounded(stage.until * factor),
                "config": _divided(stage.config, length, divisor),
                "changes": _moved(stage, factor),
            }
        )
        for stage in plan.stages
    )
    every = _rounded(plan.evaluation.every_actions / divisor)
    return plan.model_copy(
        update={
            "counted_in": "actions",
            "stages": stages,
            "config": _divided(_with_defaults(plan.config), length, divisor),
            "evaluation": plan.evaluation.model_copy(update={"every_actions": every}),
        }
    )


def _with_defaults(config: Tree) -> Tree:
    """The values added that a smaller scale changes where the plan leaves them at the default."""
    default = Config()
    named = {section: {key: getattr(getattr(default, section), key)} for section, key in _PERIODS}
    return merged(merged({"memory": {"capacity": default.memory.capacity}}, named), config)


def _divided(config: Tree, length: float, divisor: int) -> Tree:
    """Differences to a configuration, with smaller memories, and with periods in actions.

    length: Mean actions of an episode.
    """
    result = merged({}, config)
    memory = config.get("memory", {})
    for key in _SIZES:
        if value := memory.get(key, 0):
            least = LEAST_CAPACITY if key == "capacity" else 1
            result = merged(result, {"memory": {key: max(least, value // divisor)}})
    for section, key in _PERIODS:
        named = config.get(section, {})
        if every := named.get(f"{key}_actions", 0):
            result = merged(result, {section: {f"{key}_actions": _rounded(every / divisor)}})
        elif key in named:
            actions = _rounded(named[key] * length / divisor) if named[key] else 0
            result = merged(result, {section: {f"{key}_actions": actions}})
    return result


def _moved(stage: Stage, factor: float) -> tuple[Tree, ...]:
    return tuple({**change, "at": _rounded(change["at"] * factor)} for change in stage.changes)


def _rounded(value: float) -> int:
    return max(1, round(value))
