"""Training in reduced precision: the forward pass is exact, the gradient is the right one."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from shared.config import NetworkConfig
from shared.rl import trunk
from shared.rl.network import QNetwork, initialised

torch.set_num_threads(1)
LAYOUTS = ["ccpccp", "cpcccp"]
ROUNDING = 2.0**-9
"""bfloat16 keeps 8 bits: rounding changes a number by this part of it at most."""
LARGEST_ERROR = 4 * 3 * ROUNDING
"""Four stages, each with gradient, input and weight rounded: what adds up if all err one way.
How much of it shows depends on the processor: some add in float32, some round in between."""


def gradients(network: QNetwork, maps: torch.Tensor) -> dict[str, torch.Tensor]:
    """Gradients of a loss that weighs every map differently."""
    weights = torch.linspace(-1.0, 1.0, maps.numel()).reshape(maps.shape)
    names = [name for name, _ in network.named_parameters() if name.startswith("conv")]
    parameters = [network.get_parameter(name) for name in names]
    found = torch.autograd.grad((maps.square() * weights).sum(), parameters)
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("filters", [4, 16])
def test_maps_are_the_same_bits_and_gradients_point_the_same_way(layout: Any, filters: int) -> None:
    network = initialised(NetworkConfig(filters=filters, layout=layout), seed=2)
    images = torch.rand((6, 1, 50, 75), generator=torch.Generator().manual_seed(1))
    images = images.contiguous(memory_format=torch.channels_last)
    plain, reduced = network.maps(images), trunk.maps(network, images)
    assert torch.equal(plain, reduced)
    expected, found = gradients(network, plain), gradients(network, reduced)
    assert found.keys() == expected.keys()
    bound = LARGEST_ERROR if filters == 4 else 0.01  # more filters: errors cancel each other
    for name, gradient in found.items():
        assert gradient.dtype == torch.float32
        assert gradient.shape == expected[name].shape
        cosine = torch.cosine_similarity(gradient.flatten(), expected[name].flatten(), dim=0)
        assert float(cosine) > 0.999, name
        assert float(gradient.norm() / expected[name].norm()) == pytest.approx(1.0, abs=bound)
    whole = [torch.cat([g.flatten() for g in each.values()]) for each in (found, expected)]
    assert float(torch.cosine_similarity(*whole, dim=0)) > 0.9999


def test_gradients_of_the_reduced_trunk_cannot_be_differentiated_again() -> None:
    network = initialised(NetworkConfig(filters=4), seed=2)
    maps = trunk.maps(network, torch.rand(2, 1, 50, 75))
    (first,) = torch.autograd.grad(maps.sum(), network.conv4.weight, create_graph=True)
    with pytest.raises(RuntimeError):
        first.sum().backward()
