"""The benchmark of retention as data: settings, entries, seeds, and what each network gets."""

import tomllib
from importlib import resources
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator

from experiments.plans.plan import Plan, merged, stage_config
from experiments.plans.scales import load_plan
from experiments.retention.offline import Method
from experiments.retention.refresh import Way
from shared.config import Config, Name, Section
from shared.errors import ConfigError, first_problem, not_among

Count = Annotated[int, Field(ge=1)]
Names = Annotated[tuple[Name, ...], Field(strict=False)]
FILE = "benchmark.toml"


class Setting(Section):
    """A stream: the plan that is recorded, and how large."""

    name: Name
    plan: Name
    scale: Name
    marks: Names = ()
    """Stages at whose end a network learns; empty: those of the benchmark."""
    exploratory: bool = False
    """Whether all entries manage it, and not the primary ones alone."""


class Entry(Section):
    """A way to manage the memory."""

    name: Name
    primary: bool = False
    memory: dict[str, Any]
    """Settings of the memory that differ from those of the plan."""
    refresh: Way = "none"
    """How rewards are refreshed."""
    refresh_every: Annotated[float, Field(ge=0.0)] = 0.0
    """How often, in multiples of N actions; 0: never."""
    offline: Method | None = None
    """How it chooses from everything that came, in place of managing it as it comes."""
    steps: Annotated[int, Field(ge=0)] = 0
    """Gradient steps of its networks; 0: those of the benchmark."""
    networks: Count = 1
    """How many networks learn from each memory, from weights of their own."""


class Benchmark(Section):
    """Everything that is fixed before the runs."""

    steps: Count
    averaged_steps: Count
    marks: Names
    worlds: Names
    starts: Count
    actions: Count
    primary_seeds: Count
    exploratory_seeds: Count
    settings: Annotated[tuple[Setting, ...], Field(strict=False)]
    entries: Annotated[tuple[Entry, ...], Field(strict=False)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for what in (self.settings, self.entries):
            names = [each.name for each in what]
            if len(set(names)) < len(names):
                raise ValueError(f"names must differ, got {names}")
        return self

    def setting(self, name: str) -> Setting:
        """Return the setting of this name. Raises ConfigError."""
        found = next((each for each in self.settings if each.name == name), None)
        if found is None:
            raise not_among("--setting", name, [each.name for each in self.settings])
        return found

    def entries_of(self, setting: Setting, seed: int) -> list[Entry]:
        """Return the entries that a seed of a setting has, primary ones first."""
        chosen = [entry for entry in self.entries if self.wanted(entry, setting, seed)]
        return sorted(chosen, key=lambda entry: not entry.primary)

    def wanted(self, entry: Entry, setting: Setting, seed: int) -> bool:
        """Whether an entry is measured with this seed of a setting."""
        if entry.primary:
            return seed <= self.primary_seeds
        return setting.exploratory and seed <= self.exploratory_seeds


class Work(NamedTuple):
    """What one entry does with one seed of a setting."""

    setting: Setting
    entry: Entry
    seed: int


def load_benchmark() -> Benchmark:
    """Return the benchmark in `benchmark.toml`. Raises ConfigError where it is wrong."""
    text = resources.files("experiments").joinpath("retention", FILE).read_text("utf-8")
    return read_benchmark(text)


def read_benchmark(text: str) -> Benchmark:
    """Return the benchmark in the text of a file. Raises ConfigError where it is wrong."""
    try:
        found = Benchmark.model_validate(tomllib.loads(text))
    except ValidationError as error:
        raise ConfigError(f"{FILE}: {first_problem(error)}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{FILE}: {error}") from error
    for setting in found.settings:
        plan = load_plan(setting.plan, setting.scale)
        stages = {stage.name for stage in plan.stages}
        if unknown := {*(setting.marks or found.marks)} - stages:
            raise ConfigError(f"{FILE}: {setting.name}: no stages {', '.join(sorted(unknown))}")
        for entry in found.entries:
            config_of(plan, entry, seed=1)
    return found


def config_of(plan: Plan, entry: Entry, seed: int) -> Config:
    """Return the configuration with which an entry manages the stream of a plan.

    Eq 3.5 is left to `refresh`. Raises ConfigError.
    """
    memory = {**entry.memory, "equalise_every": 0, "equalise_every_actions": 0}
    own = plan.model_copy(update={"config": merged(plan.config, {"memory": memory})})
    return stage_config(own, 0, seed)
