"""`corridor playback`: does an actor choose today what it chose when it was recorded?

Every recorded observation goes through preprocessing, the recorded network and the actor's decision
with the recorded seed and numerics; what comes out is compared with the recorded action.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from services.recorder.reader import Recording
from shared.config import Config
from shared.errors import ConfigError, StateError
from shared.messages import PROTOCOL_VERSION, Action, ImageArray, Observation, image_array
from shared.rl.policy import decide
from shared.rl.predictor import Predictor
from shared.rl.preprocess import PREPROCESS_VERSION, preprocess

KEPT_NETWORKS = 4


@dataclass
class Comparison:
    """What became of every recorded action."""

    equal: int = 0
    different: int = 0
    exact: int = 0
    """Equal actions whose predictions are the same bits, too."""
    skipped: Counter[str] = field(default_factory=Counter)
    """Actions that were not compared, by reason."""
    first: str = ""
    """The first difference, in one line."""

    @property
    def passed(self) -> bool:
        """Whether something was compared, and nothing differs."""
        return self.equal > 0 and not self.different

    def lines(self) -> list[str]:
        """The result for people."""
        total = self.equal + self.different
        told = [f"{self.equal} of {total} actions equal, {self.exact} of them to the last bit"]
        told += [f"{count} not compared: {why}" for why, count in sorted(self.skipped.items())]
        if self.first:
            told.append(f"first difference: {self.first}")
        return told


def run(path: Path, echo: Callable[[str], None]) -> int:
    """Play a recording back; 0 if all compared actions are equal, 1 if not, or if there are none.

    Raises ConfigError for no file, or one for another version or an engine that is not installed
    here; StateError for a damaged one.
    """
    recording = Recording(path)
    if not recording.complete:
        echo(f"{path}: breaks off; what came before is compared")
    for name, count in recording.summary.items():
        if count and name.startswith(("lost", "refused")):
            echo(f"{path}: {name}: {count} when it was recorded")
    found = compare(recording)
    if recording.undecodable:
        echo(f"{path}: {recording.undecodable} messages are none of the protocol")
    for line in found.lines():
        echo(line)
    return 0 if found.passed else 1


def compare(recording: Recording) -> Comparison:
    """Compare every recorded action with what the actor chooses now. Raises like `run`."""
    origin = recording.origin
    for what, there, here in (
        ("protocol", origin.protocol, PROTOCOL_VERSION),
        ("preprocessing", origin.preprocessing, PREPROCESS_VERSION),
    ):
        if there != here:
            raise ConfigError(f"the recording is of {what} {there}, this is {here}")
    network, found = _networks(recording), Comparison()
    for observation, action in recording.turns():
        _compare(origin.config, network, observation, action, found)
    return found


def _compare(
    config: Config,
    networks: Callable[[int], Predictor | None],
    observation: Observation | None,
    action: Action,
    found: Comparison,
) -> None:
    if action.action is None:
        found.skipped["robot held still, or moved by hand or on the spot"] += 1
        return
    if action.weights_version == 0 or action.by == "human":
        found.skipped["driven by a network that is not the run's, or by a person"] += 1
        return
    if observation is None:
        found.skipped["its observation is not in the recording"] += 1
        return
    network = networks(action.weights_version)
    if network is None:
        found.skipped["its version of the weights is not in the recording"] += 1
        return
    values = network.all_values(seen_again(image_array(observation.image))[np.newaxis])[0]
    chosen, by = decide(
        config,
        action.robot,
        values,
        filling=action.filling,
        episode=action.fills if action.filling else action.episode,
        step=action.step,
    )
    if (chosen, by) == (action.action, action.by):
        found.equal += 1
        found.exact += int(tuple(values.tolist()) == action.values)
        return
    found.different += 1
    if not found.first:
        found.first = (
            f"robot {action.robot!r}, sequence {action.sequence}, weights "
            f"{action.weights_version}: recorded action {action.action} "
            f"({_text(action.values)}), now {chosen} ({_text(values.tolist())})"
        )


def seen_again(image: ImageArray) -> ImageArray:
    """A recorded image through preprocessing: grey in three channels, it must come out the same."""
    again = preprocess(np.repeat(image[:, :, np.newaxis], 3, axis=2))
    if not np.array_equal(again, image):
        raise StateError("preprocessing changes an image that has its size and is grey already")
    return again


def _networks(recording: Recording) -> Callable[[int], Predictor | None]:
    """The recorded networks by version; None for one that is not there."""
    origin = recording.origin
    if origin.numerics.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("the recording's actor computed on a GPU, and there is none here")
    try:
        none = Predictor(origin.config.network, origin.numerics)
    except (ImportError, ValueError) as error:
        raise ConfigError(f"the recording's numerics.actor: {error}") from error

    @lru_cache(KEPT_NETWORKS)
    def of(version: int) -> Predictor | None:
        if version not in recording.weights:
            return None
        try:
            return none.successor(version, recording.load(version))
        except ValueError as error:
            raise StateError(f"recorded weights of version {version}: {error}") from error

    return of


def _text(values: tuple[float, ...] | list[float]) -> str:
    return " ".join(f"{value:+.4f}" for value in values)
