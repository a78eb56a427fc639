"""Networks that a run left behind, for driving without learning."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load as load_safetensors
from safetensors.torch import save as save_safetensors

from shared.config import ActorNumerics, NetworkConfig, Numerics
from shared.errors import ConfigError, StateError
from shared.provenance import BUNDLE, Bundle
from shared.rl.predictor import Predictor
from shared.settings import FILE_NAME

CHECKPOINT = Path("learner") / "checkpoint.safetensors"
WEIGHTS = Path("weights.safetensors")
TARGET = "target."
"""Tensors of the network that acts begin with this in a checkpoint (A26)."""


@dataclass(frozen=True)
class Frozen:
    """A network's parameters, and how far it had learnt as far as its file tells."""

    path: Path
    data: bytes
    """As safetensors: the parameters of the target network alone."""
    episode: int | None = None
    train_steps: int | None = None
    metadata: dict[str, str] = field(default_factory=dict)
    """What else the file tells of itself, as text."""

    def predictor(self, network: NetworkConfig, numerics: Numerics | None = None) -> Predictor:
        """The network ready to predict: one image at a time unless `numerics` tell otherwise.

        Raises ConfigError when it is not of this shape.
        """
        predictor = Predictor(network, numerics or ActorNumerics())
        try:
            predictor.load(0, self.data)
        except ValueError as error:
            raise ConfigError(
                f"{self.path}: not a network with network.filters = {network.filters}: {error}"
            ) from error
        return predictor


def packed(data: bytes, made: Bundle) -> bytes:
    """Weights as a file that says what it is."""
    return save_safetensors(load_safetensors(data), {BUNDLE: made.model_dump_json()})


def find(run: Path) -> Path:
    """The file with the network of a run: its folder, or the file itself. Raises ConfigError."""
    if run.is_file():
        return run
    for name in (CHECKPOINT, WEIGHTS):
        if (run / name).is_file():
            return run / name
    if not run.exists():
        raise ConfigError(f"run {run}: there is no such folder or file")
    raise ConfigError(f"run {run}: expected {CHECKPOINT} or {WEIGHTS} in it, found neither")


def configuration_of(run: Path) -> Path | None:
    """The stored configuration of a run, beside its file of weights or above, if there is one."""
    folders = [run] if run.is_dir() else [run.parent, run.parent.parent]
    return next((f / FILE_NAME for f in folders if (f / FILE_NAME).is_file()), None)


def read(path: Path) -> Frozen:
    """Read a checkpoint of the learner, or a file of weights. Raises StateError when damaged."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = dict(file.metadata() or {})
            state = json.loads(metadata.pop("state", "{}"))
            counters = state.get("counters", {}) if isinstance(state, dict) else None
            if not isinstance(counters, dict):
                raise ValueError("expected an object as its state")
            if BUNDLE in state:
                metadata[BUNDLE] = json.dumps(state[BUNDLE])
            names = list(file.keys())
            prefix = TARGET if any(name.startswith(TARGET) for name in names) else ""
            tensors = {
                name.removeprefix(prefix): file.get_tensor(name).contiguous()
                for name in names
                if name.startswith(prefix)
            }
    except (OSError, SafetensorError, ValueError) as error:
        raise StateError(f"{path}: damaged weights: {error}") from error
    episode, steps = state.get("episode"), counters.get("train_steps")
    return Frozen(path, save_safetensors(tensors), episode, steps, metadata)
