"""What a memory is worth: a network that learns from it alone, and drives."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from experiments.drives.choosers import greedy, side_by_side
from experiments.drives.frozen_drives import evaluate
from experiments.drives.traces import Figures
from experiments.environment import CorridorEnv, with_world
from shared.config import Config, LearnerNumerics
from shared.rl.gradients import MeanOfWeights
from shared.rl.learning import Trainer
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, to_bytes
from shared.rl.predictor import Predictor
from shared.rl.schedule import Moment


def learned(
    samples: SampleStore,
    config: Config,
    numerics: LearnerNumerics,
    seed: int,
    steps: int,
    averaged: int,
) -> bytes:
    """Let a network learn from these samples from random weights on.

    Args:
        samples: What it learns from, in shuffled epochs.
        config: Network and learning rule.
        numerics: How gradients are computed.
        seed: Of the first weights and of the order of the samples.
        steps: How many gradient steps.
        averaged: Of so many last steps the weights are averaged.

    Returns:
        The mean of the weights, as safetensors bytes.
    """
    epochs = -(-steps * config.learning.batch_size // len(samples)) + 1
    learning = config.learning.model_copy(
        update={"fit_every": 1, "fit_every_actions": 0, "fit_epochs": epochs}
    )
    trainer = Trainer(config.network, learning, numerics, seed)
    mean = MeanOfWeights(trainer.train_network)
    for done, _ in enumerate(islice(trainer.learn(samples, Moment(1)), steps), 1):
        if done > steps - averaged:
            mean.take()
    network = QNetwork(config.network).requires_grad_(False)
    mean.copy_to(network)
    return to_bytes(network)


def driven(
    weights: bytes, config: Config, worlds: Sequence[str], starts: int, actions: int
) -> dict[str, Figures]:
    """Let a frozen network drive in worlds; return the figures of each."""
    network = Predictor(config.network, side_by_side(config.numerics.actor))
    network.load(1, weights)
    found = {}
    for world in worlds:
        env = CorridorEnv(config=with_world(config, world))
        try:
            found[world] = evaluate(env, greedy(network), starts, actions).figures
        finally:
            env.close()
    return found
