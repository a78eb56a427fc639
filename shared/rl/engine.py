"""What runs the network for predictions: PyTorch here, OpenVINO in a file of its own."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from shared.facts import ACTION_COUNT, IMAGE_SHAPE
from shared.rl.descriptor import BLOCKS, block_sums, unit_sums
from shared.rl.network import HIDDEN, QNetwork, channels_last

if TYPE_CHECKING:
    from shared.config import Numerics

Images = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
Head = Literal["values", "sums", "units", "hidden"]
"""Clipped Q(s, a) of all actions [n, 3]; the sums descriptors are made of, of maps or of units of
FConn1 [n, 16]; or FConn3 and the unclipped Q of all actions, one action after the other."""
WIDTHS: dict[Head, int] = {
    "values": ACTION_COUNT,
    "sums": BLOCKS,
    "units": BLOCKS,
    "hidden": ACTION_COUNT * (HIDDEN + 1),
}
Progress = Callable[[int, int], None]
"""Called with (images done, images in all)."""


class Engine(Protocol):
    """Runs one version of the network; an image's bits are the same, whichever come with it."""

    def load(self, network: QNetwork) -> None:
        """Take over the network's parameters."""

    def run(self, images: Images, head: Head, progress: Progress | None = None) -> Floats:
        """Outputs of one head for images uint8 [n, 50, 75]: float32 [n, width of the head].

        Raises ValueError for sums of a network that has none (see `descriptor.block_sums`).
        """


class TorchEngine:
    """PyTorch, on the CPU or on a GPU, where the outputs stay until the last pass is done.

    Its bits depend on the number of images in a pass, so all passes have the same, padded.
    """

    def __init__(self, numerics: Numerics) -> None:
        self._numerics = numerics
        self._network: QNetwork | None = None

    def load(self, network: QNetwork) -> None:
        """Copy the network to the device, laid out for speed."""
        own = channels_last(copy.deepcopy(network)).to(self._numerics.device)
        self._network = own.eval().requires_grad_(False)

    def run(self, images: Images, head: Head, progress: Progress | None = None) -> Floats:
        """See `Engine.run`."""
        assert self._network is not None, "no weights are loaded"
        outputs = []
        with arithmetic(self._numerics), torch.inference_mode():
            for part, count, done in padded(images, self._numerics.images_per_pass):
                tensor = network_input(part, self._numerics.device)
                maps = self._maps(self._network, tensor)
                outputs.append(_output(self._network, maps, head)[:count])
                if progress is not None:
                    progress(done, len(images))
        if not outputs:
            return np.zeros((0, WIDTHS[head]), np.float32)
        return np.asarray(torch.cat(outputs).cpu().numpy())

    def _maps(self, network: QNetwork, images: Tensor) -> Tensor:
        """MaxPool2 maps in float32, the convolutions in the role's precision."""
        if self._numerics.precision == "float32":
            return network.maps(images)
        with torch.autocast(self._numerics.device, torch.bfloat16):
            return network.maps(images).to(torch.float32)


@contextmanager
def arithmetic(numerics: Numerics) -> Iterator[None]:
    """Apply a role's thread count and precision. Raises ValueError for unsettled numerics.

    Threads are set every time: torch keeps some of its counts by thread, others for all of them.
    """
    if not numerics.settled:
        raise ValueError(f"numerics must be settled before use, got {numerics}")
    torch.set_num_threads(numerics.threads)
    if numerics.device != "cuda":
        yield
        return
    reduced = numerics.precision != "float32"
    with torch.backends.cudnn.flags(enabled=True, benchmark=True, allow_tf32=reduced):
        yield


def network_input(images: Images, device: str) -> Tensor:
    """uint8 [n, 50, 75] to float32 [n, 1, 50, 75] in [0, 1] (A22)."""
    return scaled(torch.from_numpy(np.array(images)).to(device))  # received images are read-only


def scaled(images: Tensor) -> Tensor:
    """uint8 [n, 50, 75] to float32 [n, 1, 50, 75] in [0, 1], laid out as convolutions want it."""
    channels_last = images.unsqueeze(-1).permute(0, 3, 1, 2)
    return channels_last.to(torch.float32).div_(255.0)


def padded(images: Images, size: int) -> Iterator[tuple[Images, int, int]]:
    """Parts of exactly `size` images, the last one padded; how many count, and all done so far."""
    for start in range(0, len(images), size):
        part = images[start : start + size]
        count = len(part)
        if count < size:
            filled = np.zeros((size, *IMAGE_SHAPE), np.uint8)
            filled[:count] = part
            part = filled
        yield part, count, start + count


def _output(network: QNetwork, maps: Tensor, head: Head) -> Tensor:
    if head == "sums":
        return block_sums(maps)
    if head == "units":
        return unit_sums(network.state(maps))
    if head == "hidden":
        hidden = network.all_hidden(maps)
        return torch.cat([hidden, network.out(hidden)], dim=1).reshape(len(maps), -1)
    return network.all_values(maps).clamp(-1.0, 1.0)
