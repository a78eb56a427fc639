"""Smaller scales: what they divide, what they count, and how wide their network is (E39)."""

from __future__ import annotations

import pytest

from experiments.plans.plan import Plan, read_plan, stage_config
from experiments.plans.scales import LEAST_CAPACITY, divisor_of, load_plan, scaled
from shared.errors import ConfigError

TEXT = """
title = "t"
source = "s"
{top}
[thesis]
episodes = 100
actions = 10000
{config}
[[stages]]
name = "a"
until = 40
[stages.config.memory]
capacity = 9000
capacity_max = 20000
[[stages]]
name = "b"
until = 99
[[stages.changes]]
at = 51
kind = "remove"
name = "box"
[stages.config.learning]
fit_every = 25
mini_batches_per_episode = 2
"""


def plan(top: str = "", config: str = "") -> Plan:
    return read_plan("small", TEXT.format(top=top, config=config))


def test_actions_are_counted_and_divided_like_memories() -> None:
    tenth = scaled(plan(), "tenth")
    assert tenth.counted_in == "actions"
    assert [stage.until for stage in tenth.stages] == [400, 990]
    assert tenth.stages[1].changes == ({"at": 510, "kind": "remove", "name": "box"},)
    assert tenth.evaluation.every_actions == plan().evaluation.every_actions // 10
    first, second = (stage_config(tenth, i, 1) for i in (0, 1))
    assert (first.memory.capacity, first.memory.capacity_max) == (900, 2000)
    assert first.memory.equalise_every_actions == 50 * 100 // 10  # of 50, the default
    assert first.learning.fit_every_actions == 100 * 100 // 10
    assert second.learning.fit_every_actions == 25 * 100 // 10
    assert second.learning.mini_batches_per_episode == 2
    assert second.memory.capacity == 900  # kept from the stage before
    fifth = stage_config(scaled(plan(), "fifth"), 0, 1)
    assert (fifth.memory.capacity, fifth.memory.equalise_every_actions) == (1800, 1000)


def test_a_plan_that_counts_actions_is_divided_without_an_episode() -> None:
    own = plan('counted_in = "actions"', "[config.memory]\nequalise_every_actions = 30")
    tenth = scaled(own, "tenth")
    assert [stage.until for stage in tenth.stages] == [4, 10]
    assert stage_config(tenth, 0, 1).memory.equalise_every_actions == 3


def test_what_never_happens_does_not_happen_at_a_smaller_scale() -> None:
    never = plan(config="[config.memory]\nequalise_every = 0\n[config.learning]\nfit_every = 0")
    first = stage_config(scaled(never, "tenth"), 0, 1)
    assert (first.memory.equalise_every, first.memory.equalise_every_actions) == (0, 0)
    assert (first.learning.fit_every, first.learning.fit_every_actions) == (0, 0)


def test_no_memory_gets_smaller_than_one_long_episode() -> None:
    text = TEXT.format(top="", config="").replace("capacity = 9000", "capacity = 2000")
    tenth = scaled(read_plan("small", text), "tenth")
    assert stage_config(tenth, 0, 1).memory.capacity == LEAST_CAPACITY


def test_the_network_is_narrow_or_wide_as_the_scale_says() -> None:
    found = {
        scale: stage_config(scaled(plan(), scale), 0, 1)
        for scale in ("full", "tenth", "tenth-wide", "fifth", "fifth-wide")
    }
    assert {scale: config.network.filters for scale, config in found.items()} == {
        "full": 64, "tenth": 16, "tenth-wide": 64, "fifth": 16, "fifth-wide": 64,
    }  # fmt: skip
    assert found["tenth"].memory == found["tenth-wide"].memory
    for config in found.values():  # measured where it runs
        assert (config.numerics.replay.engine, config.numerics.learner.device) == ("auto", "auto")
    assert found["tenth"].numerics.learner.batch == 16


def test_what_a_plan_has_at_smaller_scales_counts_there_alone() -> None:
    own = plan(config='[small.policy]\nkind = "roulette"\n[small.network]\nfilters = 8')
    for scale, kind, filters in (("full", "eps-greedy-roulette", 64), ("tenth", "roulette", 8)):
        config = stage_config(scaled(own, scale), 0, 1)
        assert (config.policy.kind, config.network.filters) == (kind, filters)


def test_a_plan_of_fixed_size_only_gets_a_narrow_network() -> None:
    own = plan("fixed_size = true")
    tenth = scaled(own, "tenth")
    assert (tenth.stages, tenth.counted_in) == (own.stages, "episodes")
    config = stage_config(tenth, 0, 1)
    assert (config.memory.capacity, config.network.filters) == (9000, 16)
    assert (divisor_of(own, "tenth"), divisor_of(plan(), "tenth")) == (1, 10)


def test_episodes_of_unknown_length_cannot_be_counted_as_actions() -> None:
    text = TEXT.format(top="", config="").replace("actions = 10000", "")
    with pytest.raises(ConfigError, match=r"plan small: .*expected episode_actions"):
        scaled(read_plan("small", text), "tenth")
    told = text.replace("[thesis]", "episode_actions = 100\n[thesis]")
    assert scaled(read_plan("small", told), "tenth").stages == scaled(plan(), "tenth").stages


def test_an_unknown_scale_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"expected one of full, fifth, .*got 'mini'"):
        scaled(plan(), "mini")


@pytest.mark.parametrize(
    ("name", "scale", "meant"), [("plus-rm", "tenth", "plus-rmm"), ("plus-rmm", "tent", "tenth")]
)
def test_a_mistyped_plan_or_scale_is_answered_with_the_nearest(
    name: str, scale: str, meant: str
) -> None:
    with pytest.raises(ConfigError, match=rf"did you mean {meant}\?"):
        load_plan(name, scale)
