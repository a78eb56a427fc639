"""Discarding against an oracle written from the rules (A27-A34, A44, E17b, E19-E22)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import oracles
import pytest
from builders import FakePredictor, image_with
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import BITS_OF_PERCENT, Sample

from shared.config import MemoryConfig
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.retention import rmm
from shared.rl.retention.rmm import candidates_by_action, force_candidates, scaled_count
from shared.rl.retention.strategy import Discard, Situation, discard, kept_in_total, kept_of_action

FAST = settings(deadline=None, max_examples=80, derandomize=True)


class Bench:
    """A memory and the oracle's samples, side by side."""

    def __init__(self, capacity: int, **config: Any) -> None:
        self.config = MemoryConfig(capacity=max(capacity, 30), **config)
        self.memory = ReplayMemory(capacity)
        self.samples: list[Sample] = []
        self.network = FakePredictor()
        self.percent = self.config.threshold_percent
        self._next_id = 1

    def add(self, *kinds: tuple[int, int]) -> None:
        """Samples given as (action, descriptor's number)."""
        rows = np.zeros(len(kinds), SAMPLE)
        images = []
        for row, (action, number) in zip(rows, kinds, strict=True):
            descriptor = number.to_bytes(15, "big")
            row["id"], row["action"] = self._next_id, action
            self.samples.append(Sample(self._next_id, action, descriptor))
            images.append(image_with(descriptor))
            self._next_id += 1
        rows["world"] = self.memory.world_indices(["plus"])[0]
        shape = (len(kinds), 50, 75)
        self.memory.append(rows, np.frombuffer(b"".join(images), np.uint8).reshape(shape))

    def force(self, *ids: int) -> None:
        force_candidates(self.memory, np.array(ids, np.uint64))
        for sample in self.samples:
            if sample.id in ids:
                sample.forced = sample.candidate = True

    def discard(self) -> Discard:
        """Discard in both; all they did and all that remains must be equal."""
        before = len(self.memory)
        expected = oracles.discard(
            self.samples,
            self.memory.capacity,
            self.percent,
            strategy=self.config.strategy,
            rule=self.config.rule,
            percent_max=self.config.threshold_max_percent,
            recompute_below=self.config.recompute_below,
            raise_at_most=self.config.raise_at_most,
            capacity_max=self.config.capacity_max,
            capacity_step=self.config.capacity_step or oracles.scaled(5000, self.config.capacity),
        )
        capacity, percent = self.memory.capacity, self.percent
        decreed = {s.id for s in self.samples if s.forced}
        found = discard(Situation(self.memory, 0, self.config, self.network, seed=1))
        assert [int(i) for i in found.ids] == expected.removed
        assert found.told["recomputed"] == expected.recomputed
        assert found.told["last_resort"] == expected.last_resort
        assert found.told["threshold_percent"] == expected.percent
        assert found.capacity == self.memory.capacity == expected.capacity
        assert [int(i) for i in self.memory.ids] == [s.id for s in self.samples]
        assert [bool(c) for c in self.memory.rows["candidate"]] == [
            s.candidate for s in self.samples
        ]
        assert [bool(f) for f in self.memory.rows["forced"]] == [s.forced for s in self.samples]
        self.memory.check_valid()
        self._check_quotas(before)
        self._check_growth(found, capacity, percent, decreed)
        self.percent = found.told["threshold_percent"]
        return found

    def _check_growth(self, found: Discard, capacity: int, percent: int, decreed: set[int]) -> None:
        """What holds whatever the rules of a single discard are (A44, E32)."""
        most = max(capacity, self.config.capacity_max)
        assert capacity <= found.capacity <= most
        if found.capacity > capacity:
            assert found.told["recomputed"]
        if found.told["threshold_percent"] > percent or (
            found.told["last_resort"] and self.config.strategy == "rmm"
        ):
            assert found.capacity == most
        if found.told["threshold_percent"] > percent:
            assert (found.capacity, found.told["threshold_percent"]) == (capacity, percent + 1)
        kept = self.memory.rows[["id", "candidate", "forced"]].tolist()
        assert {i for i, candidate, forced in kept if candidate and forced} == decreed - {
            int(i) for i in found.ids
        }

    def _check_quotas(self, before: int) -> None:
        capacity = self.memory.capacity
        assert len(self.memory) <= capacity
        if before <= capacity:  # also when it has just grown
            assert len(self.memory) == before
            return
        if self.config.strategy == "normm":
            assert len(self.memory) == 99 * capacity // 100
            return
        for count in self.memory.by_action():
            assert count <= 99 * capacity // 300 or 3 * count <= capacity


# ------------------------------------------------------------------------- counts


def test_kept_counts_are_exact_for_every_capacity() -> None:
    assert [kept_in_total(n) for n in (45000, 100, 101, 2000, 50000, 90000)] == [
        44550, 99, 99, 1980, 49500, 89100,
    ]  # fmt: skip
    assert [kept_of_action(n) for n in (45000, 300, 100, 2000, 50000, 90000)] == [
        14850, 99, 33, 660, 16500, 29700,
    ]  # fmt: skip
    for n in range(1, 3000):
        assert 100 * kept_in_total(n) <= 99 * n < 100 * (kept_in_total(n) + 1)
        assert 300 * kept_of_action(n) <= 99 * n < 300 * (kept_of_action(n) + 1)


def test_counts_of_the_thesis_hold_from_45000_on_and_scale_below() -> None:
    for capacity in (45000, 50000, 90000):
        assert scaled_count(1000, capacity) == 1000
        assert scaled_count(2000, capacity) == 2000
    assert (scaled_count(1000, 6000), scaled_count(2000, 6000)) == (133, 267)
    assert (scaled_count(1000, 30), scaled_count(2000, 30)) == (1, 1)
    assert scaled_count(1000, 44999) == 1000
    for capacity in range(1, 45000, 7):
        assert scaled_count(1000, capacity) == oracles.scaled(1000, capacity)


# ------------------------------------------------------------------------- against the oracle

few_kinds = st.tuples(
    st.sampled_from([0, 0, 0, 1, 1, 2]), st.sampled_from([0, 1, 3, 7, 255, 1 << 60])
)
many_kinds = st.tuples(st.integers(0, 2), st.integers(0, 2**120 - 1))
additions = st.lists(
    st.one_of(st.lists(few_kinds, max_size=25), st.lists(many_kinds, max_size=25)), max_size=8
)


@FAST
@given(
    rounds=additions,
    capacity=st.integers(3, 40),
    strategy=st.sampled_from(["rmm", "rmm", "normm"]),
    rule=st.sampled_from(["paper", "cover"]),
    below=st.sampled_from([0, 1, 4]),
    most=st.sampled_from([0, 1, 6]),
    growth=st.sampled_from([(0, 0), (0, 0), (60, 0), (60, 5), (60, 40)]),
    data=st.data(),
)
def test_repeated_discards_equal_the_rules(
    rounds: list[list[tuple[int, int]]],
    capacity: int,
    strategy: Literal["rmm", "normm"],
    rule: Literal["paper", "cover"],
    below: int,
    most: int,
    growth: tuple[int, int],
    data: st.DataObject,
) -> None:
    bench = Bench(
        capacity,
        strategy=strategy,
        rule=rule,
        recompute_below=below,
        raise_at_most=most,
        capacity_max=growth[0],
        capacity_step=growth[1],
    )
    for kinds in rounds:
        bench.add(*kinds)
        if bench.samples and data.draw(st.integers(0, 3)) == 0:
            bench.force(data.draw(st.sampled_from([s.id for s in bench.samples])))
        elif data.draw(st.integers(0, 9)) == 0:
            bench.force(*[s.id for s in bench.samples])
        if data.draw(st.integers(0, 4)) == 0:
            bench.memory.set_capacity(data.draw(st.integers(3, 60)))
        bench.network.version += data.draw(st.integers(0, 1))
        bench.discard()


# ------------------------------------------------------------------------- the single rules


@pytest.mark.parametrize("strategy", ["rmm", "normm"])
def test_a_memory_that_holds_exactly_its_capacity_is_left_alone(strategy: str) -> None:
    bench = Bench(30, strategy=strategy)
    bench.add(*[(0, 0)] * 30)
    found = bench.discard()
    assert (len(found.ids), found.told["recomputed"], bench.network.described) == (0, False, [])


def test_normm_drops_the_oldest_whatever_their_action() -> None:
    bench = Bench(100, strategy="normm")
    bench.add(*[(i % 2, i) for i in range(104)])
    assert list(bench.discard().ids) == [1, 2, 3, 4, 5]
    assert bench.network.described == []


def test_rmm_touches_only_actions_above_one_third() -> None:
    bench = Bench(30)
    bench.add(*[(0, 0)] * 11, *[(1, 0)] * 10, *[(2, 0)] * 10)
    found = bench.discard()
    assert list(found.ids) == [1, 2]  # 9 = 99 * 30 // 300 of action 0 remain
    assert bench.memory.by_action() == [9, 10, 10]


def test_oldest_candidates_go_first_and_dissimilar_old_samples_stay() -> None:
    bench = Bench(30)
    unique = [(0, (2**11 - 1) << (12 * i)) for i in range(5)]
    bench.add(*unique, *[(0, 0)] * 26)
    found = bench.discard()
    assert list(found.ids) == list(range(6, 28))
    assert found.told["last_resort"] == 0
    assert list(bench.memory.ids[:5]) == [1, 2, 3, 4, 5]


def test_marks_are_computed_anew_only_when_too_few_candidates_are_left() -> None:
    bench = Bench(300, recompute_below=10)
    bench.add(*[(0, 0)] * 101, *[(1, 0)] * 100, *[(2, 0)] * 100)
    assert bench.discard().told["recomputed"]
    searches = []
    for i in range(46):
        bench.add((0, (2**11 - 1) << 2 * i), (0, (2**11 - 1) << 2 * i + 1))
        left = candidates_by_action(bench.memory)[0]
        searches.append((left, bench.discard().told["recomputed"]))
    assert searches == [(left, False) for left in range(98, 8, -2)] + [(8, True)]


@pytest.mark.parametrize(("candidates", "expected"), [(10, False), (9, True)])
def test_a_search_begins_below_the_limit_of_candidates(candidates: int, expected: bool) -> None:
    bench = Bench(300, recompute_below=10)
    bench.add(*[(0, 0)] * 101, *[(1, 0)] * 100, *[(2, 0)] * 100)  # two of action 0 must go
    bench.force(*range(1, candidates + 1))
    found = bench.discard()
    assert bool(found.told["recomputed"]) is expected
    assert list(found.ids) == [1, 2]


@pytest.mark.parametrize(("forced", "capacity"), [(60, 300), (19, 310)])
def test_candidates_by_decree_count_for_the_action_that_must_discard(
    forced: int, capacity: int
) -> None:
    """E46: both limits are counts of that action alone, marks by decree included."""
    bench = Bench(300, recompute_below=70, raise_at_most=40, capacity_max=400, capacity_step=10)
    far = [(0, (2**11 - 1) << i) for i in range(0, 109, 2)]  # none looks like another
    bench.add(*far, *[(0, 0)] * 21, *unlike(1, 25), *[(1, 0)] * 100, *[(2, 0)] * 100)
    bench.force(*range(1, forced + 1))
    found = bench.discard()
    assert (found.told["recomputed"], found.capacity) == (True, capacity)


def test_few_candidates_of_an_action_below_its_quota_do_not_trigger_a_search() -> None:
    bench = Bench(300, recompute_below=10)
    bench.add(*[(0, 0)] * 101, *[(1, 0)] * 100, *[(2, 0)] * 100)
    bench.force(*range(1, 30))
    assert not bench.discard().told["recomputed"]


def test_a_search_comes_before_the_last_resort() -> None:
    """E21 applies only to what is still missing after E19."""
    bench = Bench(30, recompute_below=1, raise_at_most=1)
    bench.add(*[(0, 0)] * 31)
    bench.force(1, 2)
    found = bench.discard()
    assert (found.told["recomputed"], found.told["last_resort"], len(found.ids)) == (True, 0, 22)


def test_what_candidates_cannot_cover_goes_by_age_and_is_counted() -> None:
    bench = Bench(30)
    bench.add(*[(0, (2**11 - 1) << (3 * i)) for i in range(31)])
    bench.force(20, 25)
    found = bench.discard()
    assert found.told["last_resort"] == 20
    assert list(found.ids) == [*range(1, 22), 25]  # 20 and 25, then the 20 oldest others
    assert len(bench.memory) == 9


def test_forced_marks_outlive_a_recomputation_and_go_with_their_samples() -> None:
    bench = Bench(300, recompute_below=50)
    bench.add(*[(0, (2**11 - 1) << i) for i in range(100)])
    bench.add(*[(1, 0)] * 201)
    bench.force(7, 150)
    assert bench.discard().told["recomputed"]
    assert bench.memory.rows["forced"][bench.memory.ranks(np.array([7], np.uint64))].all()
    bench.memory.set_capacity(150)
    bench.discard()
    assert 7 not in bench.memory.ids


def test_descriptors_of_the_same_version_are_made_once() -> None:
    bench = Bench(30, recompute_below=30)
    bench.add(*[(0, 0)] * 31)
    bench.discard()
    assert bench.network.described == [31]
    kept = len(bench.memory)
    bench.add(*[(0, 0)] * (31 - kept))
    assert bench.discard().told["recomputed"]
    assert bench.network.described == [31, 31 - kept]
    assert set(bench.memory.rows["described_by"]) == {1}
    bench.network.version = 2
    kept = len(bench.memory)
    bench.add(*[(0, 0)] * (31 - kept))
    bench.discard()
    assert bench.network.described == [31, 31 - kept, 31]
    assert set(bench.memory.rows["described_by"]) == set(bench.memory.rows["marked_by"]) == {2}


def test_a_recomputation_renews_the_marks_of_all_actions() -> None:
    bench = Bench(30)
    bench.add(*[(1, 0)] * 5, *[(0, 0)] * 26)
    bench.discard()
    assert candidates_by_action(bench.memory)[1] == 4


def test_similarity_never_crosses_actions() -> None:
    bench = Bench(30)
    bench.add((1, 0), *[(0, 0)] * 30)
    bench.discard()
    assert not bench.memory.rows["candidate"][bench.memory.rows["id"] == 1].any()


# ------------------------------------------------------------------------- threshold


def test_thresholds_in_bits_go_1_2_3_4_6_7_8_and_stay_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used: list[int] = []

    def spy(descriptors: np.ndarray, bits: int, rule: Any) -> np.ndarray:
        used.append(bits)
        return real(descriptors, bits, rule)

    real = rmm.similar_to_newer
    monkeypatch.setattr(rmm, "similar_to_newer", spy)
    rng = np.random.default_rng(1)
    bench = Bench(30)
    for _ in range(9):
        n = 31 - len(bench.memory)
        bench.add(*[(0, int.from_bytes(rng.bytes(15), "big")) for _ in range(n)])
        assert bench.discard().told["recomputed"]
    assert used[::3] == [1, 2, 3, 4, 6, 7, 8, 8, 8]
    assert bench.percent == 7


def test_the_oracle_and_the_thesis_agree_on_bits_of_percent() -> None:
    assert list(BITS_OF_PERCENT.values()) == [1, 2, 3, 4, 6, 7, 8]


@pytest.mark.parametrize(("found", "percent"), [(20, 2), (21, 1)])
def test_the_threshold_grows_when_not_more_than_the_limit_is_found(
    found: int, percent: int
) -> None:
    bench = Bench(300, recompute_below=400, raise_at_most=20)
    bench.add(*[(0, (2**11 - 1) << i) for i in range(101 - found)], *[(0, 0)] * found)
    bench.add((0, 0), *[(1, 0)] * 100, *[(2, 0)] * 100)
    result = bench.discard()
    assert (result.told["recomputed"], result.told["threshold_percent"]) == (True, percent)


def test_few_candidates_of_an_action_that_need_not_discard_do_not_raise_the_threshold() -> None:
    bench = Bench(300, recompute_below=400, raise_at_most=20)
    bench.add(*[(0, 0)] * 150, *[(1, (2**11 - 1) << i) for i in range(100)], *[(2, 0)] * 100)
    assert bench.discard().told["threshold_percent"] == 1


def test_one_action_that_must_discard_and_lacks_candidates_is_enough_to_raise() -> None:
    bench = Bench(300, recompute_below=400, raise_at_most=20)
    bench.add(*[(0, 0)] * 150, *[(1, (2**11 - 1) << (i % 100)) for i in range(105)])
    bench.add(*[(2, 0)] * 60)
    assert bench.discard().told["threshold_percent"] == 2


def test_the_threshold_is_raised_once_per_discard_and_capped() -> None:
    bench = Bench(30, threshold_percent=2, threshold_max_percent=3)
    for expected in (3, 3, 3):
        n = 31 - len(bench.memory)
        bench.add(*[(0, (2**11 - 1) << (len(bench.samples) + 7 * i) % 100) for i in range(n)])
        bench.discard()
        assert bench.percent == expected


def test_without_a_search_the_threshold_stays() -> None:
    bench = Bench(300, recompute_below=2, raise_at_most=90)
    bench.add(*[(0, 0)] * 101, *[(1, 0)] * 100, *[(2, 0)] * 100)
    bench.force(1, 2, 3)
    found = bench.discard()
    assert (found.told["recomputed"], found.told["threshold_percent"]) == (False, 1)


# ------------------------------------------------------------------------- capacity


@pytest.mark.parametrize("strategy", ["rmm", "normm"])
def test_capacity_shrinks_and_grows_while_running(strategy: str) -> None:
    bench = Bench(90, strategy=strategy)
    bench.add(*[(i % 3, i % 4) for i in range(91)])
    bench.discard()
    bench.memory.set_capacity(36)
    bench.discard()
    assert len(bench.memory) <= 36
    bench.memory.set_capacity(120)
    bench.add(*[(i % 3, 9) for i in range(84)])
    assert len(bench.discard().ids) == 0
    bench.add(*[(0, 9)] * 2)
    assert len(bench.memory) <= 122
    bench.discard()


def test_after_shrinking_the_counts_scale_with_the_new_capacity() -> None:
    bench = Bench(90)
    bench.add(*[(0, i) for i in range(91)])
    bench.memory.set_capacity(3)
    bench.discard()
    assert bench.memory.by_action()[0] == 0  # 99 * 3 // 300


def test_rmm_result_is_balanced_when_all_actions_are_above_quota() -> None:
    bench = Bench(30)
    bench.add(*[(i % 3, i % 2) for i in range(60)])
    bench.discard()
    assert bench.memory.by_action() == [9, 9, 9]


# ------------------------------------------------------------------------- growth


def unlike(first: int, count: int) -> list[tuple[int, int]]:
    """Samples of action 0 with descriptors that differ from each other in many bits."""
    draw = np.random.default_rng(first)
    return [(0, int.from_bytes(draw.bytes(15), "big")) for _ in range(count)]


def test_a_failed_search_makes_the_memory_grow_at_once_and_nothing_goes() -> None:
    bench = Bench(90, capacity_max=110, capacity_step=10)
    bench.add(*unlike(1, 91))
    found = bench.discard()
    assert (found.capacity, found.told["threshold_percent"], len(found.ids)) == (100, 1, 0)
    assert found.told["recomputed"]
    bench.add(*unlike(2, 9))
    assert not bench.discard().told["recomputed"]  # holds exactly N
    bench.add(*unlike(3, 1))
    assert (bench.discard().capacity, len(bench.memory)) == (110, 101)


def test_the_threshold_rises_only_when_the_memory_may_not_grow_any_more() -> None:
    bench = Bench(90, capacity_max=105, capacity_step=10, threshold_max_percent=3)
    steps = []
    for i in range(5):
        bench.add(*unlike(i, bench.memory.capacity + 1 - len(bench.memory)))
        found = bench.discard()
        steps.append(
            (found.capacity, found.told["threshold_percent"], found.told["last_resort"] > 0)
        )
    assert steps == [
        (100, 1, False), (105, 1, False), (105, 2, True), (105, 3, True), (105, 3, True),
    ]  # fmt: skip


def test_a_search_that_finds_enough_leaves_the_capacity_alone() -> None:
    bench = Bench(90, capacity_max=200, capacity_step=10)
    bench.add(*[(0, 0)] * 91)
    found = bench.discard()
    assert (found.told["recomputed"], found.capacity, len(bench.memory)) == (True, 90, 29)


def test_a_memory_grows_by_further_steps_rather_than_discarding_by_age() -> None:
    bench = Bench(90, capacity_max=200, capacity_step=10)
    bench.add(*unlike(1, 115))
    found = bench.discard()
    assert (found.capacity, len(found.ids), found.told["last_resort"]) == (120, 0, 0)


def test_candidates_that_cannot_cover_what_must_go_make_the_memory_grow_too() -> None:
    """More than `raise_at_most`, but fewer than the surplus: only small memories know this."""
    bench = Bench(90, capacity_max=200, capacity_step=10, raise_at_most=5)
    bench.add(*unlike(1, 71), *[(0, 0)] * 20)
    found = bench.discard()
    assert (found.capacity, found.told["threshold_percent"], found.told["last_resort"]) == (
        100,
        1,
        0,
    )


def test_normm_never_grows() -> None:
    bench = Bench(90, strategy="normm", capacity_max=200, capacity_step=10)
    bench.add(*unlike(1, 91))
    assert (bench.discard().capacity, len(bench.memory)) == (90, 89)


@pytest.mark.parametrize(("configured", "step"), [(45_000, 5000), (50_000, 5000), (90, 10)])
def test_the_step_scales_with_the_configured_capacity(configured: int, step: int) -> None:
    config = MemoryConfig(capacity=configured, capacity_max=90_000)
    for in_force in (30, 60):  # what it is now does not matter
        bench = Bench(in_force)
        bench.config = config.model_copy(update={"raise_at_most": 1, "recompute_below": 1})
        bench.add(*unlike(1, in_force + 1))
        assert bench.discard().capacity == in_force + step


def test_a_capacity_above_the_largest_one_does_not_grow_and_is_not_cut() -> None:
    bench = Bench(90, capacity_max=100)
    bench.memory.set_capacity(150)
    bench.add(*unlike(1, 151))
    assert (bench.discard().capacity, bench.percent) == (150, 2)


def test_samples_marked_by_decree_go_before_the_memory_grows() -> None:
    bench = Bench(90, capacity_max=100, capacity_step=10, raise_at_most=30, recompute_below=20)
    bench.add(*unlike(1, 90))
    bench.force(*range(1, 91))
    bench.add(*unlike(2, 1))
    found = bench.discard()
    assert (list(found.ids), found.told["recomputed"]) == (list(range(1, 63)), False)
    bench.add(*unlike(3, 62))
    found = bench.discard()  # 28 marks are left where 62 must go
    assert (found.told["recomputed"], found.capacity, found.told["last_resort"]) == (True, 100, 0)
    assert bench.memory.rows["forced"].sum() == 28


@pytest.mark.parametrize("capacity_max", [1, 89])
def test_a_largest_capacity_below_the_first_is_refused(capacity_max: int) -> None:
    with pytest.raises(ValueError, match=r"memory\.capacity_max .* at least memory\.capacity"):
        MemoryConfig(capacity=90, capacity_max=capacity_max)
