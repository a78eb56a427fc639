"""Inference by OpenVINO: the same network, compiled for this processor, for every weights version.

The only file that imports openvino, and imported only where a configuration asks for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import openvino as ov
from openvino import opset13 as ops

from shared.facts import ACTION_COUNT, IMAGE_SHAPE
from shared.rl.descriptor import BLOCKS
from shared.rl.engine import WIDTHS, Floats, Head, Images, Progress
from shared.rl.network import MAP_WIDTH, QNetwork

if TYPE_CHECKING:
    from shared.config import Numerics

MOST = 32
"""Images of one pass."""
HINTS = {"float32": "f32", "bfloat16": "bf16"}
Parameters = dict[str, Floats]
USUAL: tuple[Head, ...] = ("values", "sums")
"""Heads of the model that every weights version gets. Each other one has a model of its own: an
output more costs time in each pass."""


class OpenVinoEngine:
    """One compiled model with the usual heads; compiling takes some hundredths of a second.

    Its bits do not depend on the number of images in a pass: `numerics.batch` plays no part.
    """

    def __init__(self, numerics: Numerics) -> None:
        self._core = ov.Core()
        self._options = {
            "INFERENCE_PRECISION_HINT": HINTS[numerics.precision],
            "INFERENCE_NUM_THREADS": numerics.threads,
            "NUM_STREAMS": 1,
            # Several services share the cores: none may tie itself to one.
            "ENABLE_CPU_PINNING": False,
        }
        self._network: tuple[Parameters, tuple[bool, ...], Floats] | None = None
        self._has_sums = False
        self._requests: dict[tuple[Head, ...], ov.InferRequest] = {}

    def load(self, network: QNetwork) -> None:
        """Compile the network with its present parameters."""
        own = {name: t.detach().cpu().numpy().copy() for name, t in network.state_dict().items()}
        self._network = own, network.pooled, network.action_vectors.cpu().numpy().copy()
        self._has_sums, self._requests = _has_sums(own), {}
        self._request(USUAL)

    def _request(self, heads: tuple[Head, ...]) -> ov.InferRequest:
        """What runs these heads. A model for rare ones is compiled when one is first asked for."""
        assert self._network is not None, "no weights are loaded"
        if heads not in self._requests:
            model = _model(heads, *self._network)
            compiled = self._core.compile_model(model, "CPU", self._options)
            self._requests[heads] = compiled.create_infer_request()
        return self._requests[heads]

    def run(self, images: Images, head: Head, progress: Progress | None = None) -> Floats:
        """See `Engine.run`."""
        heads = USUAL if head in USUAL else (head,)
        request = self._request(heads)
        if head == "sums" and not self._has_sums:
            raise ValueError(f"filters must divide {BLOCKS} or be a multiple of it")
        outputs = np.empty((len(images), WIDTHS[head]), np.float32)
        place = heads.index(head)
        for start in range(0, len(images), MOST):
            part = images[start : start + MOST]
            request.infer([np.ascontiguousarray(part)], share_inputs=True)
            outputs[start : start + MOST] = request.get_output_tensor(place).data
            if progress is not None:
                progress(start + len(part), len(images))
        return outputs


def _maps(p: Parameters, pooled: tuple[bool, ...]) -> tuple[ov.Output, ov.Node]:
    """MaxPool2 maps of a parameter uint8 [n, 50, 75], and that parameter."""
    images = ops.parameter([-1, *IMAGE_SHAPE], ov.Type.u8)
    x = ops.unsqueeze(ops.convert(images, "f32"), _int(1))
    x = ops.divide(x, np.float32(255.0))
    for number, pools in enumerate(pooled, 1):
        weight, bias = p[f"conv{number}.weight"], p[f"conv{number}.bias"]
        weight = np.ascontiguousarray(weight)
        x = ops.convolution(x, weight, [1, 1], [0, 0], [0, 0], [1, 1])
        x = ops.add(x, bias.reshape(1, -1, 1, 1))
        if pools:
            x = ops.max_pool(x, [2, 2], [1, 1], [0, 0], [0, 0], [2, 2], "floor").output(0)
        x = ops.relu(x)
    return x.output(0), images


def _model(
    heads: tuple[Head, ...], p: Parameters, pooled: tuple[bool, ...], actions: Floats
) -> ov.Model:
    """A model with these heads, without sums where the network has none."""
    maps, images = _maps(p, pooled)
    make: dict[Head, Callable[[], ov.Output]] = {
        "values": lambda: _values(maps, p, actions),
        "sums": lambda: _sums(maps, len(p["conv4.bias"])),
        "units": lambda: _unit_sums(maps, p),
        "hidden": lambda: _hidden(maps, p, actions),
    }
    outputs = [make[head]() for head in heads if head != "sums" or _has_sums(p)]
    return ov.Model(outputs, [images], "q")


def _has_sums(p: Parameters) -> bool:
    filters = len(p["conv4.bias"])
    return filters % BLOCKS == 0 or BLOCKS % filters == 0


def _state(maps: ov.Output, p: Parameters) -> ov.Node:
    """FConn1 [n, 128]."""
    flat = ops.reshape(maps, np.array([0, -1]), special_zero=True)
    return ops.relu(ops.add(_product(flat, p["fconn1.weight"]), p["fconn1.bias"]))


def _all_hidden(maps: ov.Output, p: Parameters, actions: Floats) -> ov.Node:
    """FConn3 for all actions [n, 3, 128]. The action's part is the same for all images."""
    state = _state(maps, p)
    size = len(p["fconn1.bias"])
    coded = np.maximum(actions @ p["fconn2.weight"].T + p["fconn2.bias"], 0.0)
    of_action = coded @ p["fconn3.weight"][:, size:].T + p["fconn3.bias"]
    of_state = ops.unsqueeze(_product(state, p["fconn3.weight"][:, :size]), _int(1))
    return ops.relu(ops.add(of_state, of_action[None].astype(np.float32)))


def _values(maps: ov.Output, p: Parameters, actions: Floats) -> ov.Output:
    """Clipped values of all actions [n, 3]."""
    out = _out(_all_hidden(maps, p, actions), p)
    flat_out = ops.reshape(out, np.array([-1, ACTION_COUNT]), special_zero=False)
    return ops.clamp(flat_out, -1.0, 1.0).output(0)


def _hidden(maps: ov.Output, p: Parameters, actions: Floats) -> ov.Output:
    """FConn3 and unclipped value of one action after the other [n, 3 * 129]."""
    hidden = _all_hidden(maps, p, actions)
    both = ops.concat([hidden, _out(hidden, p)], 2)
    return ops.reshape(both, np.array([0, -1]), special_zero=True).output(0)


def _out(hidden: ov.Node, p: Parameters) -> ov.Node:
    """Unclipped values [n, 3, 1]."""
    return ops.add(_product(hidden, p["out.weight"]), p["out.bias"])


def _unit_sums(maps: ov.Output, p: Parameters) -> ov.Output:
    """Sums of 16 blocks of FConn1 [n, 16]."""
    blocks = ops.reshape(_state(maps, p), np.array([0, BLOCKS, -1]), special_zero=True)
    return ops.reduce_sum(blocks, _int(2), keep_dims=False).output(0)


def _sums(maps: ov.Output, filters: int) -> ov.Output:
    """Sums of 16 blocks [n, 16], as `descriptor.block_sums` takes them."""
    if filters % BLOCKS == 0:
        blocks = ops.reshape(maps, np.array([0, BLOCKS, -1]), special_zero=True)
        return ops.reduce_sum(blocks, _int(2), keep_dims=False).output(0)
    widths = [len(part) for part in np.array_split(np.arange(MAP_WIDTH), BLOCKS // filters)]
    stripes = ops.variadic_split(maps, _int(3), np.array(widths))
    sums = [
        ops.unsqueeze(ops.reduce_sum(stripe, np.array([2, 3]), keep_dims=False), _int(2))
        for stripe in stripes.outputs()
    ]
    return ops.reshape(ops.concat(sums, 2), np.array([0, -1]), special_zero=True).output(0)


def _product(x: ov.Node, weight: Floats) -> ov.Node:
    return ops.matmul(x, np.ascontiguousarray(weight), transpose_a=False, transpose_b=True)


def _int(value: int) -> ov.Node:
    return ops.constant(np.int64(value))
