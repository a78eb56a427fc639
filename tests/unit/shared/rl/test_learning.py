"""Training, fitting and the target rule against plain torch (A25, A26, A36, E8, E15, E25, E30)."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from builders import fill_store
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import LearnerNumerics, LearningConfig, NetworkConfig, Numerics
from shared.rl.batches import Batches
from shared.rl.engine import network_input
from shared.rl.learning import Trained, Trainer
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, to_bytes
from shared.rl.schedule import Moment

torch.set_num_threads(1)
SMALL = NetworkConfig(filters=4)
FAST = settings(deadline=None, max_examples=30, derandomize=True)


def make_store(n: int, seed: int = 0, first_id: int = 1) -> SampleStore:
    rng = np.random.default_rng(seed)
    store = SampleStore()
    fill_store(
        store,
        range(first_id, first_id + n),
        rng.integers(0, 3, n).tolist(),
        rng.uniform(-1, 1, n).tolist(),
    )
    return store


def make_trainer(batch: int = 16, seed: int = 1, **learning: Any) -> Trainer:
    return Trainer(SMALL, LearningConfig(**learning), Numerics(batch=batch), seed)


def parameters(network: QNetwork) -> dict[str, np.ndarray]:
    return {n: p.detach().numpy().copy() for n, p in network.named_parameters()}


class Recorder(Trainer):
    """Notes which ranks are trained instead of training."""

    def __init__(self, **learning: Any) -> None:
        super().__init__(SMALL, LearningConfig(**learning), Numerics(batch=16), 1)
        self.ranks: list[list[int]] = []
        self.mirrored: list[Any] = []
        self.gradients: Any = SimpleNamespace(compute=self._note, deferred=False)

    def _note(self, batches: Any, ranks: Any, mirrored: Any) -> torch.Tensor:
        self.ranks.append([int(r) for r in ranks])
        self.mirrored.append(mirrored)
        return torch.zeros(())

    def _descend(self) -> None:
        pass


# ------------------------------------------------------------------------- one step


def naive_loss(network: QNetwork, store: SampleStore, ranks: list[int]) -> torch.Tensor:
    """Eq 3.4 sample by sample, on the unclipped output."""
    total = torch.zeros(())
    for rank in ranks:
        image = network_input(store.images(np.array([rank])), "cpu")
        action = torch.tensor([int(store.rows["action"][rank])])
        q = network.values(network.maps(image), action)[0]
        total = total + (float(store.rows["reward"][rank]) - q) ** 2
    return total / len(ranks)


@pytest.mark.parametrize("batch", [1, 5, 16, 64])
@pytest.mark.parametrize("size", [1, 16, 21])
def test_a_step_is_one_rmsprop_step_on_the_mean_squared_error(batch: int, size: int) -> None:
    store, trainer = make_store(30), make_trainer(batch)
    naive = copy.deepcopy(trainer.train_network)
    optimiser = torch.optim.RMSprop(naive.parameters(), lr=0.00025, alpha=0.9, eps=1e-6)
    for start in (0, 3, 6):
        ranks = list(range(start, start + size))
        optimiser.zero_grad()
        loss = naive_loss(naive, store, ranks)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        assert trainer.step(store, np.array(ranks)) == pytest.approx(float(loss.detach()), rel=1e-4)
    for name, found in parameters(trainer.train_network).items():
        assert found == pytest.approx(parameters(naive)[name], abs=2e-5)
    assert trainer.train_steps == 3


def test_rmsprop_has_the_pinned_constants_and_no_momentum() -> None:
    """v <- 0.9 v + 0.1 g^2; w <- w - 0.00025 g / (sqrt(v) + 1e-6), v from 0 (A25, E30)."""
    store, trainer = make_store(8), make_trainer()
    square = {n: np.zeros_like(p) for n, p in parameters(trainer.train_network).items()}
    for _ in range(3):
        before = parameters(trainer.train_network)
        trainer.step(store, np.arange(8))
        after = parameters(trainer.train_network)
        for name, parameter in trainer.train_network.named_parameters():
            assert parameter.grad is not None
            g = parameter.grad.numpy()
            square[name] = 0.9 * square[name] + 0.1 * g * g
            expected = before[name] - 0.00025 * g / (np.sqrt(square[name]) + 1e-6)
            assert after[name] == pytest.approx(expected, abs=1e-6)


def test_training_uses_the_unclipped_output() -> None:
    """E8: outside [-1, 1] a clipped output would have no gradient."""
    store, trainer = make_store(8), make_trainer()
    with torch.no_grad():
        trainer.train_network.out.bias.fill_(5.0)
    before = float(trainer.train_network.out.bias.detach())
    assert trainer.step(store, np.arange(8)) > 10.0
    assert float(trainer.train_network.out.bias.detach()) < before


def test_loss_falls_on_a_few_samples() -> None:
    store, trainer = make_store(6), make_trainer()
    losses = [trainer.step(store, np.arange(6)) for _ in range(60)]
    assert losses[-1] < 0.3 * losses[0]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_reduced_precision_trains_float32_weights(precision: Any) -> None:
    trainer = Trainer(SMALL, LearningConfig(), Numerics(batch=8, precision=precision), 1)
    loss = trainer.step(make_store(8), np.arange(8))
    exact = make_trainer().step(make_store(8), np.arange(8))
    assert loss == pytest.approx(exact, rel=0.05)
    assert {p.dtype for p in trainer.train_network.parameters()} == {torch.float32}


@pytest.mark.parametrize("cause", ["reward", "weight"])
def test_a_loss_that_is_not_finite_changes_nothing(cause: str) -> None:
    store, trainer = make_store(8), make_trainer()
    trainer.step(store, np.arange(8))
    if cause == "reward":
        store.rows["reward"][5] = np.nan
    else:
        with torch.no_grad():
            trainer.train_network.out.bias.fill_(float("inf"))
    before = to_bytes(trainer.train_network), trainer.counters()
    moments = {n: t.clone() for n, t in trainer.tensors().items() if "square" in n}
    with pytest.raises(FloatingPointError, match="step 1"):
        trainer.step(store, np.arange(8))
    assert (to_bytes(trainer.train_network), trainer.counters()) == before
    assert all(torch.equal(t, trainer.tensors()[n]) for n, t in moments.items())
    if cause == "reward":
        trainer.step(store, np.arange(4))  # the refused gradient is forgotten
        assert trainer.train_steps == 2


# ------------------------------------------------------------------------- mini-batches


@FAST
@given(n=st.integers(1, 60), size=st.integers(1, 40), batches=st.integers(0, 4))
def test_mini_batches_are_drawn_without_replacement(n: int, size: int, batches: int) -> None:
    recorder = Recorder(batch_size=size, mini_batches_per_episode=batches, fit_every=0)
    trained = list(recorder.learn(make_store(n), Moment(3)))
    assert len(recorder.ranks) == batches
    assert [t.batch for t in trained] == list(range(1, batches + 1))
    for ranks in recorder.ranks:
        assert len(ranks) == len(set(ranks)) == min(size, n)
        assert set(ranks) <= set(range(n))


def test_mini_batches_depend_on_seed_episode_and_number_alone() -> None:
    store = make_store(50)
    one = Recorder(batch_size=8, mini_batches_per_episode=2)
    list(one.learn(store, Moment(7)))
    other = Recorder(batch_size=8, mini_batches_per_episode=2)
    list(other.learn(store, Moment(3)))
    list(other.learn(store, Moment(7)))
    assert other.ranks[2:] == one.ranks
    assert len({tuple(ranks) for ranks in other.ranks}) == 4


def test_every_sample_is_drawn_now_and_then() -> None:
    recorder = Recorder(batch_size=10, mini_batches_per_episode=100, fit_every=0)
    list(recorder.learn(make_store(40), Moment(1)))
    counts = np.bincount(np.concatenate([np.array(r) for r in recorder.ranks]), minlength=40)
    assert (abs(counts - 25) < 25).all()


def test_samples_are_trained_by_rank_wherever_their_images_lie() -> None:
    """E30: two stores with the same samples in other slots train the same, bit for bit."""
    plain, churned = make_store(12, first_id=21), SampleStore()
    fill_store(churned, range(1, 11), [0] * 10)
    fill_store(
        churned, range(21, 27), plain.rows["action"][:6].tolist(), plain.rows["reward"][:6].tolist()
    )
    churned.remove(np.array([2, 9, 4, 1, 3, 5, 6, 7, 8, 10], np.uint64))
    fill_store(
        churned, range(27, 33), plain.rows["action"][6:].tolist(), plain.rows["reward"][6:].tolist()
    )
    assert plain.rows["slot"].tolist() != churned.rows["slot"].tolist()
    trainers = [make_trainer(batch_size=8), make_trainer(batch_size=8)]
    for trainer, store in zip(trainers, (plain, churned), strict=True):
        list(trainer.learn(store, Moment(1)))
    assert to_bytes(trainers[0].train_network) == to_bytes(trainers[1].train_network)


# ------------------------------------------------------------------------- fitting


@FAST
@given(n=st.integers(1, 70), size=st.integers(1, 40), epochs=st.integers(1, 3))
def test_fitting_visits_each_sample_once_per_epoch(n: int, size: int, epochs: int) -> None:
    recorder = Recorder(batch_size=size, fit_every=10, fit_epochs=epochs)
    trained = list(recorder.learn(make_store(n), Moment(20)))
    per_epoch = -(-n // size)
    assert len(recorder.ranks) == epochs * per_epoch == recorder.fit_batches(n)
    for epoch in range(epochs):
        parts = recorder.ranks[epoch * per_epoch : (epoch + 1) * per_epoch]
        assert [len(p) for p in parts[:-1]] == [size] * (per_epoch - 1)
        assert sorted(r for part in parts for r in part) == list(range(n))
    assert trained == [
        Trained(0.0, i // per_epoch + 1, i + 1, epochs * per_epoch) for i in range(len(trained))
    ]
    assert recorder.fits == 1


@pytest.mark.parametrize(("after_fill", "fits"), [(True, [1, 4, 8]), (False, [4, 8])])
def test_a_fit_comes_right_after_the_fill_where_it_is_asked_for(
    after_fill: bool, fits: list[int]
) -> None:
    recorder = Recorder(
        batch_size=4, fit_every=4, fit_epochs=1, mini_batches_per_episode=0,
        fit_after_fill=after_fill,
    )  # fmt: skip
    found = [e for e in range(10) if list(recorder.learn(make_store(8), Moment(e)))]
    assert found == fits


def test_epochs_are_shuffled_differently_and_the_same_in_a_second_run() -> None:
    first = Recorder(batch_size=50, fit_every=10)
    second = Recorder(batch_size=50, fit_every=10)
    list(first.learn(make_store(50), Moment(10)))
    list(second.learn(make_store(50), Moment(20)))
    list(second.learn(make_store(50), Moment(10)))
    assert second.ranks[3:] == first.ranks
    assert len({tuple(ranks) for ranks in second.ranks}) == 6
    assert first.ranks[0] != sorted(first.ranks[0])


def test_constants_are_those_of_the_thesis() -> None:
    config = LearningConfig()
    assert (config.batch_size, config.learning_rate) == (128, 0.00025)
    assert (config.mini_batches_per_episode, config.fit_every, config.fit_epochs) == (1, 100, 3)
    assert (config.rmsprop_alpha, config.rmsprop_epsilon) == (0.9, 1e-6)


def test_a_fit_takes_the_place_of_the_mini_batches() -> None:
    recorder = Recorder(batch_size=4, fit_every=5, fit_epochs=1, mini_batches_per_episode=2)
    counts = []
    for episode in range(1, 11):
        counts.append(len(list(recorder.learn(make_store(8), Moment(episode)))))
    assert counts == [2, 2, 2, 2, 2, 2, 2, 2, 2, 2]
    assert [len(r) for r in recorder.ranks] == [4] * 20
    assert recorder.fits == 2
    epoch = recorder.ranks[8:10]
    assert sorted(epoch[0] + epoch[1]) == list(range(8))


def test_the_last_partial_mini_batch_is_a_mean_over_its_own_size() -> None:
    store, trainer = make_store(5), make_trainer(batch_size=4, fit_every=1, fit_epochs=1)
    naive = make_trainer()
    losses = [t.loss for t in trainer.learn(store, Moment(1))]
    recorder = Recorder(batch_size=4, fit_every=1, fit_epochs=1)
    list(recorder.learn(store, Moment(1)))
    assert [len(r) for r in recorder.ranks] == [4, 1]
    for loss, ranks in zip(losses, recorder.ranks, strict=True):
        assert loss == pytest.approx(
            float(naive_loss(naive.train_network, store, ranks).detach()), rel=1e-4
        )
        naive.step(store, np.array(ranks))


def test_an_empty_memory_teaches_nothing() -> None:
    trainer = make_trainer(fit_every=1)
    assert list(trainer.learn(SampleStore(), Moment(1))) == []
    assert (trainer.train_steps, trainer.fits, trainer.fit_batches(0)) == (0, 0, 0)


# ------------------------------------------------------------------------- target


def test_target_starts_as_a_copy_under_version_one() -> None:
    trainer = make_trainer()
    assert trainer.version == 1
    assert to_bytes(trainer.target_network) == to_bytes(trainer.train_network)


@pytest.mark.parametrize(
    ("rule", "bump", "copied"),
    [
        ("bump", True, True),
        ("bump", False, False),
        ("episode", True, True),
        ("episode", False, True),
    ],
)
def test_target_is_copied_where_the_rule_says_so(rule: Any, bump: bool, copied: bool) -> None:
    trainer = make_trainer(target_rule=rule)
    initial = to_bytes(trainer.target_network)
    trainer.step(make_store(8), np.arange(8))
    assert to_bytes(trainer.target_network) == initial != to_bytes(trainer.train_network)
    assert trainer.apply_target_rule(5, bump) is copied
    expected = to_bytes(trainer.train_network) if copied else initial
    assert to_bytes(trainer.target_network) == expected
    assert trainer.version == 1 + copied
    assert trainer.episode_at_copy == (5 if copied else 0)


def test_the_copy_is_not_changed_by_later_training() -> None:
    trainer, store = make_trainer(), make_store(8)
    trainer.step(store, np.arange(8))
    trainer.apply_target_rule(1, True)
    copied = to_bytes(trainer.target_network)
    trainer.step(store, np.arange(8))
    assert to_bytes(trainer.target_network) == copied


def test_version_grows_only_when_the_target_changes() -> None:
    trainer, store = make_trainer(target_rule="episode"), make_store(8)
    assert not trainer.apply_target_rule(1, True)
    assert trainer.version == 1
    trainer.step(store, np.arange(8))
    assert trainer.apply_target_rule(2, False)
    assert not trainer.apply_target_rule(3, True)
    assert (trainer.version, trainer.episode_at_copy, trainer.steps_at_copy) == (2, 3, 1)


# ------------------------------------------------------------------------- restore


@pytest.mark.parametrize("steps", [0, 4])
def test_a_restored_trainer_continues_bit_for_bit(steps: int) -> None:
    store = make_store(40)

    def go_on(trainer: Trainer, episodes: range) -> list[bytes]:
        seen = []
        for episode in episodes:
            losses = [t.loss for t in trainer.learn(store, Moment(episode))]
            changed = trainer.apply_target_rule(episode, bump=episode % 2 == 0)
            state = (losses, changed, sorted(trainer.counters().items()))
            seen += [repr(state).encode(), to_bytes(trainer.train_network)]
            seen.append(to_bytes(trainer.target_network))
        return seen

    options = {"batch_size": 8, "fit_every": 3, "fit_epochs": 1, "target_rule": "bump"}
    trainer = make_trainer(**options)
    go_on(trainer, range(1, 1 + steps))
    tensors = {n: t.clone() for n, t in trainer.tensors().items()}
    counters = dict(trainer.counters())
    uninterrupted = go_on(trainer, range(1 + steps, 8))
    resumed = make_trainer(**options)
    list(resumed.learn(store, Moment(77)))  # whatever it was before
    resumed.restore(tensors, counters)
    assert go_on(resumed, range(1 + steps, 8)) == uninterrupted


@pytest.mark.parametrize("prefix", ["train.", "target.", "square_avg."])
@pytest.mark.parametrize("fault", ["missing", "shape", "dtype"])
def test_a_state_that_does_not_fit_is_refused(prefix: str, fault: str) -> None:
    trainer = make_trainer()
    tensors = {n: t.clone() for n, t in trainer.tensors().items()}
    name = prefix + "out.weight"
    if fault == "missing":
        del tensors[name]
    elif fault == "shape":
        tensors[name] = tensors[name][:, :5]
    else:
        tensors[name] = tensors[name].double()
    with pytest.raises(KeyError if fault == "missing" else ValueError, match=r"out\.weight"):
        make_trainer().restore(tensors, trainer.counters())


def test_missing_counters_are_refused() -> None:
    trainer = make_trainer()
    counters = trainer.counters()
    del counters["version"]
    with pytest.raises(KeyError, match="version"):
        make_trainer().restore(trainer.tensors(), counters)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_shares_of_several_threads_add_up_to_the_mini_batch(precision: Any) -> None:
    store, ranks, trainers = make_store(13), np.arange(13), []
    bound = 1e-5 if precision == "float32" else 0.01  # bfloat16 rounds the gradient of each part
    for threads in (1, 2, 2, 3, 16):
        numerics = LearnerNumerics(threads=threads, batch=4, precision=precision)
        trainer = Trainer(SMALL, LearningConfig(), numerics, 1)
        trainer.gradients.compute(Batches(store, "cpu"), ranks)
        trainers.append(trainer)
    alone, two, again, *others = (
        [p.grad for p in trainer.train_network.parameters()] for trainer in trainers
    )
    assert all(torch.equal(a, b) for a, b in zip(two, again, strict=True))
    for gradients in (two, *others):
        for own, expected in zip(gradients, alone, strict=True):
            assert float((own - expected).norm()) <= bound * float(expected.norm())


def flipped(store: SampleStore, which: list[int]) -> SampleStore:
    """A store in which some samples are what they would be in a mirror."""
    images = store.images(np.arange(len(store)))
    images[which] = images[which, :, ::-1]
    rows = store.rows.copy()
    for rank in which:
        rows["action"][rank] = {0: 0, 1: 2, 2: 1}[int(rows["action"][rank])]
    mirrored = SampleStore()
    mirrored.append(rows, images)
    return mirrored


@pytest.mark.parametrize("threads", [1, 3])
def test_a_mirrored_sample_trains_like_one_of_a_mirrored_corridor(threads: int) -> None:
    store, ranks, which = make_store(7), np.array([6, 0, 3, 5, 2]), [0, 2, 3]
    trainers = [
        Trainer(SMALL, LearningConfig(), LearnerNumerics(threads=threads), 1) for _ in range(2)
    ]
    ours = trainers[0].step(store, ranks, np.isin(ranks, which))
    assert ours == trainers[1].step(flipped(store, which), ranks)
    for own, other in zip(
        trainers[0].train_network.parameters(), trainers[1].train_network.parameters(), strict=True
    ):
        assert torch.equal(own, other)


def test_half_of_all_samples_are_mirrored_by_chance_where_that_is_wanted() -> None:
    settings_of = {"fit_every": 2, "mini_batches_per_episode": 3, "fit_epochs": 2}
    store, plain = make_store(300), Recorder(**settings_of)
    ours, again = (Recorder(augmentation="mirror", **settings_of) for _ in range(2))
    for trainer in (plain, ours, again):
        for episode in (1, 2):
            list(trainer.learn(store, Moment(episode)))
    assert plain.mirrored == [None] * 9
    assert ours.ranks == plain.ranks  # the choice of samples stays what it is
    assert [len(mask) for mask in ours.mirrored] == [len(ranks) for ranks in ours.ranks]
    for one, other in zip(ours.mirrored, again.mirrored, strict=True):
        np.testing.assert_array_equal(one, other)
    assert 0.4 < np.concatenate(ours.mirrored).mean() < 0.6
    assert any((a != b).any() for a, b in zip(ours.mirrored[:3], ours.mirrored[1:3], strict=False))


@pytest.mark.parametrize("episode", [1, 2])
def test_the_target_can_be_the_mean_over_the_newest_steps(episode: int) -> None:
    """Of an episode's mini-batches, or of the last epoch of a fitting phase."""
    settings_of = {"fit_every": 2, "mini_batches_per_episode": 3, "fit_epochs": 2}
    store = make_store(40)
    trainer = make_trainer(target_average=True, batch_size=16, **settings_of)
    newest = [
        (trained.epoch, parameters(trainer.train_network))
        for trained in trainer.learn(store, Moment(episode))
    ]
    assert trainer.apply_target_rule(episode, bump=False)
    seen = [weights for epoch, weights in newest if epoch == newest[-1][0]]
    assert len(seen) == 3
    for name, found in parameters(trainer.target_network).items():
        mean = np.mean([weights[name].astype(np.float64) for weights in seen], axis=0)
        np.testing.assert_allclose(found, mean, rtol=1e-5, atol=1e-7)
    untouched = parameters(trainer.train_network)
    for name, last in seen[-1].items():
        np.testing.assert_array_equal(untouched[name], last)


def test_the_mean_begins_anew_with_each_episode() -> None:
    store = make_store(40)
    trainer = make_trainer(target_average=True, batch_size=16, mini_batches_per_episode=1)
    for episode in (1, 3):
        list(trainer.learn(store, Moment(episode)))
        trainer.apply_target_rule(episode, bump=True)
        target = parameters(trainer.target_network)
        for name, weights in parameters(trainer.train_network).items():
            np.testing.assert_array_equal(target[name], weights)


def test_a_mean_over_several_episodes_is_refused() -> None:
    with pytest.raises(ValueError, match=r"learning\.target_average needs learning\.target_rule"):
        LearningConfig(target_average=True, target_rule="bump")


def test_a_share_that_fails_is_heard_of() -> None:
    trainer = Trainer(SMALL, LearningConfig(), LearnerNumerics(threads=2), 1)
    with pytest.raises(IndexError):
        trainer.step(make_store(8), np.array([0, 1, 2, 99]))
    assert trainer.train_steps == 0


def test_deferred_steps_are_the_same_steps() -> None:
    """What a GPU does runs here on the CPU: resident samples, losses read at the end."""
    learning = LearningConfig(fit_every=4, fit_epochs=2, batch_size=5)
    store = make_store(12)
    plain = Trainer(SMALL, learning, LearnerNumerics(batch=4), 1)
    losses = [t.loss for t in plain.learn(store, Moment(4))]
    deferred = Trainer(SMALL, learning, LearnerNumerics(batch=4), 1)
    deferred.gradients.deferred = True
    steps = list(deferred.learn(store, Moment(4)))
    assert [done.epoch for done in steps] == [1, 1, 1, 2, 2, 2]
    assert [done.loss for done in steps[:-1]] == [None] * 5
    assert steps[-1].loss == pytest.approx(np.mean([loss for loss in losses if loss is not None]))
    assert deferred.train_steps == plain.train_steps == 6
    for name, tensor in plain.tensors().items():
        assert torch.equal(tensor, deferred.tensors()[name]), name


def test_deferred_steps_report_a_loss_that_is_not_finite() -> None:
    trainer = Trainer(SMALL, LearningConfig(batch_size=8, fit_every=100), LearnerNumerics(), 1)
    trainer.gradients.deferred = True
    with torch.no_grad():
        trainer.train_network.out.bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError):
        list(trainer.learn(make_store(8), Moment(100)))
