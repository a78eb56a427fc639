"""Inference by OpenVINO: the same network, compiled for this processor, for every weights version.

The only file that imports openvino, and imported only where a configuration asks for it.
"""

from __future__ import annotations

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


class OpenVinoEngine:
    """One compiled model with both heads; compiling takes some hundredths of a second.

    Its bits do not depend on the number of images in a pass: passes are as large as they come, up
    to `MOST`, and `numerics.batch` plays no part.
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
        self._request: ov.InferRequest | None = None
        self._heads: tuple[Head, ...] = ()

    def load(self, network: QNetwork) -> None:
        """Compile the network with its present parameters."""
        parameters = {name: t.detach().cpu().numpy() for name, t in network.state_dict().items()}
        maps, images = _maps(parameters, network.pooled)
        filters = len(parameters["conv4.bias"])
        outputs: dict[Head, ov.Output] = {
            "values": _values(maps, parameters, network.action_vectors.cpu().numpy())
        }
        if filters % BLOCKS == 0 or BLOCKS % filters == 0:
            outputs["sums"] = _sums(maps, filters)
        model = ov.Model(list(outputs.values()), [images], "q")
        compiled = self._core.compile_model(model, "CPU", self._options)
        self._request, self._heads = compiled.create_infer_request(), tuple(outputs)

    def run(self, images: Images, head: Head, progress: Progress | None = None) -> Floats:
        """See `Engine.run`."""
        assert self._request is not None, "no weights are loaded"
        if head not in self._heads:
            raise ValueError(f"filters must divide {BLOCKS} or be a multiple of it")
        outputs = np.empty((len(images), WIDTHS[head]), np.float32)
        place = self._heads.index(head)
        for start in range(0, len(images), MOST):
            part = images[start : start + MOST]
            self._request.infer([np.ascontiguousarray(part)], share_inputs=True)
            outputs[start : start + MOST] = self._request.get_output_tensor(place).data
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


def _values(maps: ov.Output, p: Parameters, actions: Floats) -> ov.Output:
    """Clipped values of all actions [n, 3].

    FConn3 multiplies state and action side by side: the action's part is the same for all images
    and computed here, once.
    """
    flat = ops.reshape(maps, np.array([0, -1]), special_zero=True)
    state = ops.relu(ops.add(_product(flat, p["fconn1.weight"]), p["fconn1.bias"]))
    size = len(p["fconn1.bias"])
    coded = np.maximum(actions @ p["fconn2.weight"].T + p["fconn2.bias"], 0.0)
    of_action = coded @ p["fconn3.weight"][:, size:].T + p["fconn3.bias"]
    of_state = ops.unsqueeze(_product(state, p["fconn3.weight"][:, :size]), _int(1))
    hidden = ops.relu(ops.add(of_state, of_action[None].astype(np.float32)))
    out = ops.add(_product(hidden, p["out.weight"]), p["out.bias"])
    flat_out = ops.reshape(out, np.array([-1, ACTION_COUNT]), special_zero=False)
    return ops.clamp(flat_out, -1.0, 1.0).output(0)


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
