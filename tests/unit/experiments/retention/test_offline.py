"""Choosing from everything that came, against naive choices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from experiments.retention.offline import Method, _herding, choose


def signs(n: int, seed: int, bits: int = 24) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).choice([-1.0, 1.0], (n, bits)).astype(np.float32)


@pytest.mark.parametrize("seed", range(5))
def test_each_centre_is_farthest_from_the_centres_before(seed: int) -> None:
    every = signs(40, seed)
    chosen = [39]
    while len(chosen) < 12:
        distances = [
            -1.0 if i in chosen else min(float((every[i] != every[j]).sum()) for j in chosen)
            for i in range(40)
        ]
        chosen.append(int(np.argmax(distances)))
    assert choose("k-centre", every, 12).tolist() == sorted(chosen)


@pytest.mark.parametrize("seed", range(5))
def test_herding_comes_as_near_to_the_mean_as_one_more_sample_can(seed: int) -> None:
    every = signs(40, seed)
    mean = every.mean(axis=0)

    def gap(ranks: list[int]) -> float:
        return float(np.linalg.norm(mean - every[ranks].mean(axis=0)))

    order = _herding(every, 12).tolist()
    for done in range(12):
        rest = [i for i in range(40) if i not in order[:done]]
        nearest = min(gap([*order[:done], i]) for i in rest)
        assert gap(order[: done + 1]) == pytest.approx(nearest, abs=1e-5)  # whichever of equal ones
    assert choose("herding", every, 12).tolist() == sorted(order)


@pytest.mark.parametrize("method", ["k-centre", "herding"])
def test_no_sample_is_chosen_twice_and_all_are_where_they_fit(method: Method) -> None:
    every = np.repeat(signs(3, 1), 5, axis=0)  # mostly alike
    assert choose(method, every, 15).tolist() == list(range(15))
    assert len(set(choose(method, every, 7).tolist())) == 7
    assert choose(method, every, 99).tolist() == list(range(15))
