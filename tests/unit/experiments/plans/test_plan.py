"""Experiments as data: the thesis's constants, the small scale, and what is refused."""

from __future__ import annotations

import pytest

from experiments.plans.plan import full_plan, merged, plan_names, read_plan, stage_config
from experiments.plans.scales import SCALES, load_plan
from services.robot_driver.simulated.world import load_world
from shared.errors import ConfigError
from shared.messages import WorldChange

SMALL = """
title = "t"
source = "s"
[[stages]]
name = "a"
until = 40
[stages.config.memory]
capacity = 400
[[stages]]
name = "b"
until = 99
[stages.config.learning]
fit_every = 25
mini_batches_per_episode = 2
"""
THESIS = {
    # stage by stage: episodes, memory, strategy, mini-batches, fit every, highest threshold, world
    "plus-normm": [(15000, 45000, "normm", 1, 0, 7, "plus")],
    "plus-normm-fit": [(5000, 45000, "normm", 5, 100, 7, "plus")],
    "plus-rmm": [
        (1000, 2000, "normm", 1, 0, 7, "plus"),
        (2000, 45000, "normm", 1, 0, 7, "plus"),
        (2999, 45000, "rmm", 0, 0, 3, "plus"),
        (7000, 45000, "rmm", 0, 100, 3, "plus"),
    ],
    "plus-rmm-nopretrain": [(5000, 45000, "rmm", 5, 100, 3, "plus")],
    "plus-minus": [
        (1500, 50000, "rmm", 0, 100, 5, "minus"),
        (3000, 50000, "rmm", 0, 100, 5, "plus"),
    ],
    "policy-roulette": [(1000, 2000, "normm", 1, 0, 7, "plus")],
    "policy-roulette-4000": [(4000, 2000, "normm", 1, 0, 7, "plus")],
}


@pytest.mark.parametrize("name", THESIS)
def test_full_scale_has_the_constants_of_the_thesis(name: str) -> None:
    """A38-A43."""
    plan = full_plan(name)
    found = []
    for index, stage in enumerate(plan.stages):
        config = stage_config(plan, index, 1)
        memory, learning = config.memory, config.learning
        found.append(
            (
                stage.until,
                memory.capacity,
                memory.strategy,
                learning.mini_batches_per_episode,
                learning.fit_every,
                memory.threshold_max_percent,
                config.robot.world,
            )
        )
        assert memory.equalise_every == 50
        assert config.network.filters == 64
        assert learning.learning_rate == 0.00025
    assert found == THESIS[name]


def test_only_the_policy_differs_between_compared_policies() -> None:
    """A38: equal weights and memory at the beginning come from an equal seed."""
    configs = [
        stage_config(full_plan(f"policy-{kind}"), 0, 1).to_dict()
        for kind in ("eps-greedy", "roulette", "eps-greedy-roulette")
    ]
    kinds = [config["policy"].pop("kind") for config in configs]
    for config in configs:
        del config["run"]["name"]
    assert kinds == ["eps-greedy", "roulette", "eps-greedy-roulette"]
    assert configs[0] == configs[1] == configs[2]


@pytest.mark.parametrize(
    ("ours", "beside"),
    [("plus-minus", "plus-minus-normm"), ("plus-rmm-nopretrain", "plus-normm-fit-alone")],
)
def test_only_the_strategy_differs_between_compared_memories(ours: str, beside: str) -> None:
    trees = [stage_config(load_plan(name, "tenth"), 0, 1).to_dict() for name in (ours, beside)]
    for tree in trees:
        for key in ("threshold_percent", "threshold_max_percent"):  # of RMM alone
            del tree["memory"][key]
        del tree["run"]["name"]
    assert [tree["memory"].pop("strategy") for tree in trees] == ["rmm", "normm"]
    assert trees[0] == trees[1]


@pytest.mark.parametrize(
    ("name", "section", "changed"),
    [
        ("quotas", "memory", {"strategy": ("rmm", "quotas")}),
        ("no-equalisation", "memory", {"equalise_every": (50, 0)}),
        ("no-fits", "learning", {"fit_every": (100, 0)}),
    ],
)
def test_rmm_is_taken_apart_one_part_at_a_time(
    name: str, section: str, changed: dict[str, tuple[int | str, int | str]]
) -> None:
    whole, apart = (
        stage_config(full_plan(plan), 0, 1).to_dict()
        for plan in ("plus-rmm-nopretrain", f"plus-rmm-{name}")
    )
    del whole["run"]["name"], apart["run"]["name"]
    for key, (before, after) in changed.items():
        assert whole[section].pop(key) == before
        assert apart[section].pop(key) == after
    assert whole == apart


@pytest.mark.parametrize("scale", SCALES)
def test_every_plan_can_be_run_after_its_predecessor(scale: str) -> None:
    for name in plan_names():
        plan = load_plan(name, scale)
        assert plan.after in ("", *plan_names())
        if plan.after:  # goes on with the same network and seeds
            before = load_plan(plan.after, scale)
            assert stage_config(before, 0, 1).network == stage_config(plan, 0, 1).network
            assert plan.seeds == before.seeds


def test_a_plan_can_say_what_it_is_like() -> None:
    plan = read_plan("other", 'like = "plus-minus"\ntitle = "t"\n[config.memory]\ncapacity = 60')
    model = full_plan("plus-minus")
    assert (plan.title, plan.after, plan.stages) == ("t", model.after, model.stages)
    assert plan.config["memory"] == {**model.config["memory"], "capacity": 60}
    assert not plan.thesis  # those figures are the other one's
    twice = read_plan("other", 'like = "plus-minus-normm"\ntitle = "t"')
    assert twice.config["memory"] == full_plan("plus-minus-normm").config["memory"]
    assert not twice.thesis
    with pytest.raises(ConfigError, match="plus-minus is like itself"):
        read_plan("plus-minus", 'like = "plus-minus-normm"')


def test_merging_changes_neither_tree() -> None:
    below, over = {"a": {"b": 1, "c": 2}}, {"a": {"b": 3}}
    assert merged(below, over) == {"a": {"b": 3, "c": 2}}
    assert (below, over) == ({"a": {"b": 1, "c": 2}}, {"a": {"b": 3}})


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("until = 99", "until = 40"), "`until` must grow"),
        (('name = "b"', 'name = "a"'), "names must differ"),
        (("capacity = 400", 'capacity = "many"'), "stage a: memory.capacity"),
        (("fit_every = 25", "fit_evry = 25"), "stage b: learning.fit_evry"),
        (('title = "t"', ""), "title"),
        (("[[stages]]", "[[stages"), "expected TOML"),
    ],
)
def test_a_wrong_plan_is_refused_in_one_line(change: tuple[str, str], complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_plan("small", SMALL.replace(*change))
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_plan_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="plus-rmm"):
        load_plan("plus-rnm", "tenth")


def test_i16c_lets_the_memory_grow_and_marks_what_was_there_before() -> None:
    """A44."""
    plan = full_plan("i16c")
    memory = stage_config(plan, 0, 1).memory
    assert (memory.capacity, memory.capacity_max, memory.capacity_step) == (50000, 90000, 5000)
    assert (memory.threshold_percent, memory.threshold_max_percent) == (5, 7)
    assert plan.stages[0].force_candidates
    assert (plan.after, plan.stages[0].until) == ("plus-minus", 3000)
    kinds = [change["kind"] for change in plan.stages[0].changes]
    assert {"place", "remove"} <= set(kinds)
    small = stage_config(load_plan("i16c", "tenth"), 0, 1).memory
    assert (small.capacity, small.capacity_max, small.capacity_step) == (5000, 9000, 500)


@pytest.mark.parametrize("name", plan_names())
def test_obstacles_of_a_schedule_are_there_when_removed_and_not_when_placed(name: str) -> None:
    plan = full_plan(name)
    for index, stage in enumerate(plan.stages):
        world = load_world(stage_config(plan, index, 1).robot.world)
        there = {obstacle.name for obstacle in world.obstacles}
        for tree in sorted(stage.changes, key=lambda change: change["at"]):
            fields = {key: value for key, value in tree.items() if key != "at"}
            change = WorldChange.model_validate(fields)
            if change.box is not None:
                assert change.box.name not in there
                there.add(change.box.name)
            else:
                there.remove(str(change.name))
