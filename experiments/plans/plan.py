"""Plans: what an experiment of the thesis consists of, as data (A38-A46).

A plan is a TOML file in `plans/`: a configuration (differences to the defaults only), stages that
change parts of it while the run goes on, the plan whose end it begins with, and how reports show
it. `full` has the exact constants, computed on a GPU where there is one. What smaller scales make
of a plan is the business of `scales`.
"""

import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from experiments.plans.presentation import INHERITED, Presentation
from shared.config import Config, Name, PolicyConfig, Section
from shared.errors import ConfigError, first_problem, not_among
from shared.settings import preset_tree

Tree = dict[str, Any]
PLANS: Traversable = resources.files("experiments").joinpath("plans")
"""The folder of all plans."""
Unit = Literal["episodes", "actions"]


class Stage(Section):
    """A part of a run with a configuration of its own."""

    name: Name
    until: Annotated[int, Field(ge=1)]
    """Where it ends: episodes or actions (`counted_in`) since the plan began."""
    config: Tree = Field(default_factory=dict)
    """What changes as the stage begins; later stages keep it."""
    force_candidates: bool = False
    """Mark all samples stored so far by decree as the stage begins (A44)."""
    changes: Annotated[tuple[Tree, ...], Field(strict=False)] = ()
    """Worlds and obstacles that change on the way: fields of `WorldChange`, but `at` in place of
    `at_episode`: episodes or actions since the plan began, at which the change is there."""


class Evaluation(Section):
    """Frozen drives during a run."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 16
    """Start poses of the drive at the end of a stage."""
    actions: Annotated[int, Field(ge=50, le=100_000)] = 400
    every_actions: Annotated[int, Field(ge=1)] = 200_000
    """Actions between two drives during a stage."""
    every_starts: Annotated[int, Field(ge=1, le=1000)] = 8
    every_length: Annotated[int, Field(ge=50, le=100_000)] = 200
    """Actions from each start of a drive during a stage."""
    lap_every_actions: Annotated[int, Field(ge=0)] = 0
    """How often to look whether the frozen policy drives a lap already, until it does; 0: never."""
    worlds: Annotated[tuple[Name, ...], Field(strict=False)] = ()
    """Where to drive as a stage ends; empty: in the world of the stage."""


class Plan(Section):
    """An experiment."""

    name: Name
    title: str
    source: str
    """The place where the thesis describes it."""
    after: str = ""
    """The plan whose end this one begins with: weights, optimiser, memory, robot (A46)."""
    preset: str = ""
    """A preset that `config` differs from; empty: the defaults."""
    counted_in: Unit = "episodes"
    """What stages and changes count. Smaller scales count actions (E39)."""
    episode_actions: Annotated[float, Field(ge=0.0)] = 0.0
    """Mean length of an episode, for scales that count actions; 0: that of `thesis`."""
    fixed_size: bool = False
    """Whether smaller scales leave it as it is, but for the width of the network: a plan whose
    memory is small already."""
    small: Tree = Field(default_factory=dict)
    """Settings that differ at smaller scales."""
    thesis: dict[str, float] = Field(default_factory=dict)
    """Figures of the thesis, to stand beside ours."""
    report: Presentation = Presentation()
    """How reports show it."""
    config: Tree = Field(default_factory=dict)
    stages: Annotated[tuple[Stage, ...], Field(strict=False)] = ()
    tours: Annotated[int, Field(ge=0, le=100)] = 0
    """Test drives with turns on the spot at the end, one from each of the world's first starts."""
    tour_policy: PolicyConfig = PolicyConfig(kind="eps-greedy", epsilon=0.0)
    """How actions are chosen on them (E33): greedily, or with some chance of what seems as good."""
    seeds: Annotated[tuple[int, ...], Field(min_length=1, strict=False)] = (1, 2, 3, 4, 5)
    """Seeds, fixed before any run. A comparison takes the first ones."""
    evaluation: Evaluation = Evaluation()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.stages and not (self.tours and self.after):
            raise ValueError("stages: expected at least one, or tours after another plan")
        ends = [stage.until for stage in self.stages]
        if ends != sorted(set(ends)):
            raise ValueError(f"stages: `until` must grow, got {ends}")
        names = [stage.name for stage in self.stages]
        if len(set(names)) < len(names):
            raise ValueError(f"stages: names must differ, got {names}")
        if any("at" not in change for stage in self.stages for change in stage.changes):
            raise ValueError("stages: expected `at` in every change")
        return self


def plan_names(folder: Traversable = PLANS) -> list[str]:
    """Names of all plans in a folder, sorted."""
    names = (entry.name for entry in folder.iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def full_plan(name: str, folder: Traversable = PLANS) -> Plan:
    """The plan of this name, as its file says it. Raises ConfigError: none, or a wrong one."""
    return read_plan(name, _text_of(name, folder), folder)


def presentations(names: Iterable[str], folder: Traversable = PLANS) -> dict[str, Presentation]:
    """How reports show experiments, by name; without a plan as by default. Raises ConfigError."""
    known = plan_names(folder)
    return {
        name: full_plan(name, folder).report if name in known else Presentation() for name in names
    }


def read_plan(name: str, text: str, folder: Traversable = PLANS) -> Plan:
    """The plan in the text of a file; `folder` has those it may be `like`. Raises ConfigError."""
    try:
        plan = Plan.model_validate({"name": name, **_tree((name,), text, folder)})
    except ValidationError as error:
        raise ConfigError(f"plan {name}: {first_problem(error)}") from error
    if plan.preset:
        plan = plan.model_copy(update={"config": merged(preset_tree(plan.preset), plan.config)})
    check(plan)
    return plan


def check(plan: Plan) -> None:
    """Raise ConfigError where the configuration of a stage is wrong."""
    for index in range(max(1, len(plan.stages))):
        stage_config(plan, index, seed=1)


def stage_config(plan: Plan, index: int, seed: int) -> Config:
    """The whole configuration in force during a stage. Raises ConfigError."""
    tree: Tree = {"run": {"name": plan.name, "seed": seed}}
    for part in (plan.config, *(stage.config for stage in plan.stages[: index + 1])):
        tree = merged(tree, part)
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        stage = f", stage {plan.stages[index].name}" if plan.stages else ""
        raise ConfigError(f"plan {plan.name}{stage}: {first_problem(error)}") from error


def merged(tree: Tree, over: Mapping[str, Any]) -> Tree:
    """A tree of tables with another laid over it."""
    result = dict(tree)
    for key, value in over.items():
        below = result.get(key)
        both = isinstance(value, Mapping) and isinstance(below, Mapping)
        result[key] = merged(dict(below), value) if both else value  # type: ignore[arg-type]
    return result


def _text_of(name: str, folder: Traversable) -> str:
    known = plan_names(folder)
    if name not in known:
        raise not_among("experiment", name, known)
    return folder.joinpath(f"{name}.toml").read_text("utf-8")


def _tree(names: tuple[str, ...], text: str, folder: Traversable) -> Tree:
    """The tables of a plan, laid over those of the one it is `like`; lists are replaced.

    names: The plan, after the plans that are like it.
    """
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"plan {names[-1]}: expected TOML: {error}") from error
    like = str(tree.pop("like", ""))
    if not like:
        return tree
    if like in names:
        raise ConfigError(f"plan {names[0]}: like: {like} is like itself")
    below = _tree((*names, like), _text_of(like, folder), folder)
    thesis = below.pop("thesis", {})  # figures of another experiment, of which one stays
    if "actions" in thesis:
        below.setdefault("episode_actions", thesis["actions"] / thesis["episodes"])
    report = below.get("report", {})
    below["report"] = {key: report[key] for key in INHERITED if key in report}
    return merged(below, tree)
