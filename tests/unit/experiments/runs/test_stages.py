"""Changes of the world on the way: told to the driver in time, each once (A44)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from experiments.plans.plan import Plan, Unit, read_plan
from experiments.runs import stages
from experiments.runs.totals import Totals
from shared.errors import ConfigError
from shared.messages import WorldChange

TEXT = """
title = "t"
source = "s"
counted_in = "{unit}"
[[stages]]
name = "a"
until = 100
changes = [
    {{ at = 1, kind = "remove", name = "first" }},
    {{ at = 20, kind = "remove", name = "second" }},
    {{ at = 21, kind = "remove", name = "third" }},
]
"""


class Driven:
    """A loop that only counts, and a driver that notes what it is told."""

    def __init__(self, refusal: str = "") -> None:
        self.told: list[WorldChange] = []
        self.counters = SimpleNamespace(episode=0, actions=0)
        self.env = SimpleNamespace(driver=SimpleNamespace(change=self.change))
        self._refusal = refusal

    def change(self, wish: WorldChange) -> Any:
        self.told.append(wish)
        return SimpleNamespace(accepted=not self._refusal, reason=self._refusal)


def plan(unit: Unit) -> Plan:
    return read_plan("small", TEXT.format(unit=unit))


@pytest.mark.parametrize("unit", ["episodes", "actions"])
def test_a_change_is_there_in_the_episode_that_its_number_is_reached_in(unit: Unit) -> None:
    loop, totals = Driven(), Totals(episodes_before=1000, actions_before=90_000)
    when: dict[str, int] = {}
    for episode in range(1, 60):
        loop.counters.episode = 1000 + (episode if unit == "episodes" else episode // 7) - 1
        loop.counters.actions = 90_000 + (episode if unit == "actions" else 50 * episode) - 1
        own = plan(unit)
        stages.change_world(loop, own, own.stages[0], totals)  # type: ignore[arg-type]
        for wish in loop.told[len(when) :]:
            assert wish.at_episode == loop.counters.episode + 1  # the next one
            when[wish.name] = episode
    assert when == {"first": 1, "second": 20, "third": 21}


def test_changes_that_are_late_are_all_made_up_for() -> None:
    """An episode may step over more than one."""
    loop, totals = Driven(), Totals()
    loop.counters.actions = 500
    own = plan("actions")
    stages.change_world(loop, own, own.stages[0], totals)  # type: ignore[arg-type]
    assert [wish.name for wish in loop.told] == ["first", "second", "third"]


def test_a_driver_that_refuses_ends_the_run() -> None:
    own = plan("episodes")
    with pytest.raises(ConfigError, match="plan small: remove: it stands elsewhere"):
        stages.change_world(
            Driven("it stands elsewhere"),  # type: ignore[arg-type]
            own,
            own.stages[0],
            Totals(),
        )
