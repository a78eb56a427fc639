"""The convolutions for training in reduced precision: forward in float32, backward in bfloat16.

Rounding the forward pass bends the gradient; rounding the backward pass, two thirds of the work,
only adds noise that averages out. benchmarks/training_step.py measures both.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from shared.rl.network import QNetwork

_aten = torch.ops.aten
_CONV = ([1, 1], [0, 0], [1, 1], False, [0, 0], 1)
"""Stride, padding, dilation, transposed, output padding and groups of every convolution."""
_SIZE = ([2, 2], [2, 2])
"""Window and stride of every pool."""
_POOL = (*_SIZE, [0, 0], [1, 1], False)
"""Its padding, dilation and rounding as well."""


def maps(network: QNetwork, images: Tensor) -> Tensor:
    """What `QNetwork.maps` returns, bit for bit, with gradients computed in bfloat16."""
    parameters = [p for conv in network.convolutions for p in (conv.weight, conv.bias)]
    out: Tensor = _Trunk.apply(images, network.pooled, *parameters)  # type: ignore[no-untyped-call]
    return out


class _Trunk(torch.autograd.Function):
    """All stages in one: between them gradients stay in bfloat16, which autograd would widen."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, pooled: tuple[bool, ...], *parameters: Tensor) -> Tensor:
        x, inputs, places, ctx.sizes = images, [images.bfloat16()], [], []
        for stage, pools in enumerate(pooled):
            x = _aten.convolution(x, *parameters[2 * stage : 2 * stage + 2], *_CONV)
            ctx.sizes.append(x.shape)
            if pools:
                x, place = _aten.max_pool2d_with_indices(x, *_SIZE)
                places.append(place)
            x.relu_()
            inputs.append(x.bfloat16())
        weights = parameters[::2]
        ctx.pooled = pooled
        ctx.save_for_backward(*inputs, *weights, *places)
        return x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        stages = len(ctx.pooled)
        saved = ctx.saved_tensors
        inputs, weights = saved[: stages + 1], saved[stages + 1 : 2 * stages + 1]
        places = list(saved[2 * stages + 1 :])
        found: list[Tensor | None] = []
        flow = gradient.bfloat16()
        for stage in reversed(range(stages)):
            flow = _aten.threshold_backward(flow, inputs[stage + 1], 0)
            if ctx.pooled[stage]:
                shape = torch.empty(
                    ctx.sizes[stage],
                    dtype=flow.dtype,
                    device=flow.device,
                    memory_format=torch.channels_last,
                )
                flow = _aten.max_pool2d_with_indices_backward(flow, shape, *_POOL, places.pop())
            needed = [stage > 0, True, True]
            flow, weight, bias = _aten.convolution_backward(
                flow,
                inputs[stage],
                weights[stage].bfloat16(),
                [len(weights[stage])],
                *_CONV,
                needed,
            )
            found = [weight.float(), bias.float(), *found]
        return None, None, *found
