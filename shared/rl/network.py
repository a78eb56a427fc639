"""The Q network (section 3.4, Fig 3.6): one grey image and one action in, one reward out."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors.torch import load as load_safetensors
from safetensors.torch import save as save_safetensors
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (the customary name)

from shared.facts import ACTION_BITS, ACTIONS, IMAGE_SHAPE
from shared.rl.draws import generator

if TYPE_CHECKING:
    from shared.config import NetworkConfig

POOLED = {"ccpccp": (False, True, False, True), "cpcccp": (True, False, False, True)}
"""Which of the four convolutions a pool follows, by layout (E16)."""
HIDDEN = 128
"""Units of FConn1 and of FConn3."""
MAX_WEIGHT_BYTES = 64 * 1024 * 1024
MAX_HEAD_BYTES = 64 * 1024
"""What a file of weights may have beside its parameters."""
SHAPE = "network"
"""Where metadata of weights say what network they are of. One name: several have no fixed order."""


def _map_size(size: int) -> int:
    """Height or width of the last maps: valid padding, stride 1, floor pooling (E16)."""
    for pooled in POOLED["ccpccp"]:  # the other layout comes to the same
        size = (size - 2) // (2 if pooled else 1)
    return size


MAP_HEIGHT, MAP_WIDTH = map(_map_size, IMAGE_SHAPE)


class QNetwork(nn.Module):
    """Conv1-4, two pools, FConn1-3 and Out; 1,238,337 parameters at 64 filters (A23)."""

    action_vectors: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        filters = config.filters
        self.layout = config.layout
        self.pooled = POOLED[config.layout]
        self.conv1 = nn.Conv2d(1, filters, 3)
        self.conv2 = nn.Conv2d(filters, filters, 3)
        self.conv3 = nn.Conv2d(filters, filters, 3)
        self.conv4 = nn.Conv2d(filters, filters, 3)
        self.fconn1 = nn.Linear(filters * MAP_HEIGHT * MAP_WIDTH, HIDDEN)
        self.fconn2 = nn.Linear(ACTION_BITS, 32)
        self.fconn3 = nn.Linear(HIDDEN + 32, HIDDEN)
        self.out = nn.Linear(HIDDEN, 1)
        self.register_buffer(
            "action_vectors", torch.tensor([action.vector for action in ACTIONS]), persistent=False
        )

    @property
    def convolutions(self) -> tuple[nn.Conv2d, ...]:
        """Conv1-4 in order."""
        return self.conv1, self.conv2, self.conv3, self.conv4

    def maps(self, images: Tensor) -> Tensor:
        """MaxPool2 feature maps [n, filters, 9, 15] of images [n, 1, 50, 75] in [0, 1].

        ReLU comes after pooling where the two meet: both orders are equal, this one is cheaper.
        """
        x = images
        for conv, pooled in zip(self.convolutions, self.pooled, strict=True):
            x = conv(x)
            if pooled:
                x = F.max_pool2d(x, 2)
            x = F.relu(x)
        return x

    def state(self, maps: Tensor) -> Tensor:
        """Outputs of FConn1 [n, 128] from maps [n, filters, 9, 15]."""
        return F.relu(self.fconn1(maps.flatten(1)))

    def values(self, maps: Tensor, actions: Tensor) -> Tensor:
        """Unclipped Q(s, a) [n] from maps [n, filters, 9, 15] and action numbers [n]."""
        action = F.relu(self.fconn2(self.action_vectors[actions]))
        hidden = F.relu(self.fconn3(torch.cat([self.state(maps), action], dim=1)))
        return torch.as_tensor(self.out(hidden)).squeeze(1)

    def all_values(self, maps: Tensor) -> Tensor:
        """Unclipped Q(s, a) [n, actions] of all actions: one trunk, three heads."""
        return torch.as_tensor(self.out(self.all_hidden(maps))).view(len(maps), -1)

    def all_hidden(self, maps: Tensor) -> Tensor:
        """Outputs of FConn3 for all actions of the first image, then the next: [n actions, 128]."""
        state, encoded = self.state(maps), F.relu(self.fconn2(self.action_vectors))
        n, actions = len(state), len(encoded)
        states = state.unsqueeze(1).expand(n, actions, -1).reshape(n * actions, -1)
        return F.relu(self.fconn3(torch.cat([states, encoded.repeat(n, 1)], dim=1)))


def initialised(config: NetworkConfig, seed: int) -> QNetwork:
    """A network with Glorot uniform weights and zero biases (A23), drawn from the run's seed."""
    network = QNetwork(config)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if parameter.dim() == 1:
                parameter.zero_()
                continue
            receptive = parameter[0, 0].numel()
            fan_out, fan_in = parameter.shape[0] * receptive, parameter.shape[1] * receptive
            bound = float(np.sqrt(6.0 / (fan_in + fan_out)))
            drawn = generator(seed, "initial weights", name).uniform(-bound, bound, parameter.shape)
            parameter.copy_(torch.from_numpy(drawn.astype(np.float32)))
    return channels_last(network)


def channels_last(network: QNetwork) -> QNetwork:
    """The network with its convolutions laid out for speed; the values stay the same."""
    for parameter in network.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


def shape_of(network: QNetwork) -> dict[str, Any]:
    """What weights must fit beside the shapes of their tensors, which do not tell all of it."""
    return {
        "layout": network.layout,
        "filters": network.conv1.out_channels,
        "image": list(IMAGE_SHAPE),
        "white": 255,
        "actions": [list(action.vector) for action in ACTIONS],
    }


def to_bytes(network: QNetwork) -> bytes:
    """The parameters as safetensors bytes, float32, the same bytes for the same parameters."""
    tensors = {name: p.detach().cpu().contiguous() for name, p in network.state_dict().items()}
    shape = json.dumps(shape_of(network), sort_keys=True)
    return save_safetensors(dict(sorted(tensors.items())), {SHAPE: shape})


def load_bytes(network: QNetwork, data: bytes) -> None:
    """Take over parameters from safetensors bytes: all or, with ValueError, none (`checked`)."""
    tensors = checked(network, data, shaped=False)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_(tensors[name])


def checked(network: QNetwork, data: bytes, *, shaped: bool = True) -> dict[str, Tensor]:
    """The tensors in safetensors bytes, once size, names, shapes, types and values are right.

    network: has names and shapes; its values do not matter. shaped: require that the metadata tell
    the shape of the network, as older files do not. Raises ValueError.
    """
    most = min(MAX_WEIGHT_BYTES, 4 * parameter_count(network) + MAX_HEAD_BYTES)
    if len(data) > most:
        raise ValueError(f"weights: at most {most} bytes, got {len(data)}")
    try:
        tensors = load_safetensors(data)
        head = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        told = head.get("__metadata__", {}).get(SHAPE)
        shape = None if told is None else json.loads(told)
    except Exception as error:
        raise ValueError(f"weights: not safetensors: {error}") from error
    if shape != shape_of(network) and (shaped or shape is not None):
        raise ValueError(f"weights: expected those of {shape_of(network)}, got {shape!r:.200}")
    own = network.state_dict()
    if tensors.keys() != own.keys():
        odd = sorted(tensors.keys() ^ own.keys())
        raise ValueError(f"weights: expected the tensors {sorted(own)}, differs in {odd}")
    for name, tensor in tensors.items():
        if tensor.shape != own[name].shape or tensor.dtype != torch.float32:
            raise ValueError(
                f"weights: {name}: expected float32 {list(own[name].shape)}, "
                f"got {tensor.dtype} {list(tensor.shape)}"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"weights: {name}: not finite")
    return tensors


def weights_hash(data: bytes) -> str:
    """First 16 hex digits of SHA-256 over safetensors bytes."""
    return hashlib.sha256(data).hexdigest()[:16]


def parameter_count(network: QNetwork) -> int:
    """Number of trained parameters: 1,238,337 at 64 filters."""
    return sum(p.numel() for p in network.parameters())
