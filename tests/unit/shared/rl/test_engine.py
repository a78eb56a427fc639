"""Whatever engine predicts, it is the same network: one suite for all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from shared.config import NetworkConfig, Numerics
from shared.rl.descriptor import block_sums, describe, unit_sums
from shared.rl.engine import Engine, network_input
from shared.rl.network import QNetwork, initialised, to_bytes
from shared.rl.predictor import Predictor, engine

torch.set_num_threads(1)
ENGINES = ["torch", "openvino"]
SHAPES = [(16, "ccpccp"), (16, "cpcccp"), (8, "ccpccp"), (4, "cpcccp"), (32, "ccpccp")]


def make_network(filters: int, layout: Any, seed: int = 5) -> QNetwork:
    network = initialised(NetworkConfig(filters=filters, layout=layout), seed)
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.dim() == 1:
                parameter.uniform_(-0.05, 0.05, generator=torch.Generator().manual_seed(seed))
    return network


def make_engine(kind: Any, network: QNetwork, **numerics: Any) -> Engine:
    made = engine(Numerics(engine=kind, **{"batch": 4, **numerics}))
    made.load(network)
    return made


def make_images(count: int) -> np.ndarray:
    return np.random.default_rng(count).integers(0, 256, (count, 50, 75), np.uint8)


@pytest.mark.parametrize("kind", ENGINES)
@pytest.mark.parametrize(("filters", "layout"), SHAPES)
def test_outputs_are_those_of_the_network(kind: str, filters: int, layout: str) -> None:
    network, images = make_network(filters, layout), make_images(10)
    with torch.no_grad():
        maps = network.maps(network_input(images, "cpu"))
        values, sums = network.all_values(maps).clamp(-1, 1), block_sums(maps)
    made = make_engine(kind, network)
    assert made.run(images, "values") == pytest.approx(values.numpy(), abs=1e-5)
    assert made.run(images, "sums") == pytest.approx(sums.numpy(), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("kind", ENGINES)
def test_units_and_hidden_are_those_of_the_network(kind: Any) -> None:
    network, images = make_network(16, "ccpccp"), make_images(10)
    with torch.no_grad():
        maps = network.maps(network_input(images, "cpu"))
        units, hidden = unit_sums(network.state(maps)), network.all_hidden(maps)
        values = network.all_values(maps).numpy()
    predictor = Predictor(NetworkConfig(filters=16), Numerics(engine=kind, batch=4))
    predictor.load(3, to_bytes(network))
    assert make_engine(kind, network).run(images, "units") == pytest.approx(
        units.numpy(), rel=1e-4, abs=1e-4
    )
    assert np.array_equal(
        predictor.unit_descriptors(images),
        describe(make_engine(kind, network).run(images, "units")),
    )
    actions = np.arange(10, dtype=np.uint8) % 3
    found, own = predictor.hidden(images, actions)
    assert found.shape == (10, 128)
    expected = hidden.reshape(10, 3, 128).numpy()[np.arange(10), actions]
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-5)
    assert own == pytest.approx(values[np.arange(10), actions], abs=1e-5)
    assert predictor.hidden(images[:0], actions[:0])[0].shape == (0, 128)


@pytest.mark.parametrize("kind", ENGINES)
def test_the_first_predictor_is_that_of_a_new_run(kind: Any) -> None:
    config, numerics = NetworkConfig(filters=16), Numerics(engine=kind, batch=4)
    predictor, fresh = Predictor(config, numerics), Predictor(config, numerics)
    predictor.load(3, to_bytes(make_network(16, "ccpccp")))
    fresh.load(1, to_bytes(initialised(config, 7)))
    images = make_images(5)
    first = predictor.first(7)
    assert first.version == 1
    assert predictor.successor(4, to_bytes(make_network(16, "ccpccp"))).first(7) is first
    assert np.array_equal(first.descriptors(images), fresh.descriptors(images))
    assert not np.array_equal(first.descriptors(images), predictor.first(8).descriptors(images))
    assert predictor.version == 3


def openvino_rounds() -> bool:
    """Whether OpenVINO computes in bfloat16 here; elsewhere it takes float32 instead."""
    import openvino

    return "BF16" in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


@pytest.mark.parametrize("kind", ENGINES)
def test_bfloat16_is_close(kind: str) -> None:
    network, images = make_network(16, "ccpccp"), make_images(8)
    exact = make_engine(kind, network).run(images, "values")
    reduced = make_engine(kind, network, precision="bfloat16").run(images, "values")
    assert np.array_equal(exact, reduced) == (kind == "openvino" and not openvino_rounds())
    assert reduced == pytest.approx(exact, abs=0.02)


@pytest.mark.parametrize("kind", ENGINES)
def test_an_image_gives_the_same_bits_in_every_company(kind: str) -> None:
    made, images = make_engine(kind, make_network(16, "ccpccp")), make_images(11)
    together = made.run(images, "values")
    assert np.array_equal(made.run(images[:9], "values"), together[:9])
    assert np.array_equal(made.run(images[8:], "values"), together[8:])
    other = np.concatenate([images[:1], make_images(3)])
    assert np.array_equal(made.run(other, "values")[0], together[0])


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_openvino_gives_the_same_bits_in_passes_of_every_size(precision: str) -> None:
    """What lets it go without padding."""
    images = make_images(70)
    made = make_engine("openvino", make_network(32, "ccpccp"), precision=precision)
    together = {head: made.run(images, head) for head in ("values", "sums")}
    for size in (1, 2, 3, 4, 7, 8, 31, 32, 33, 64):
        for head, expected in together.items():
            parts = [made.run(images[i : i + size], head) for i in range(0, 70, size)]
            assert np.array_equal(np.concatenate(parts), expected), (size, head)


@pytest.mark.parametrize("kind", ENGINES)
def test_values_are_clipped(kind: str) -> None:
    network = make_network(16, "ccpccp")
    with torch.no_grad():
        network.out.bias.fill_(5.0)
    assert np.all(make_engine(kind, network).run(make_images(3), "values") == 1.0)


@pytest.mark.parametrize("kind", ENGINES)
def test_loading_again_replaces_the_weights_and_keeps_none_of_the_given(kind: str) -> None:
    network, images = make_network(16, "ccpccp"), make_images(3)
    made = make_engine(kind, network)
    before = made.run(images, "values")
    with torch.no_grad():
        network.out.bias.add_(0.25)
    assert np.array_equal(made.run(images, "values"), before)
    made.load(network)
    assert made.run(images, "values") == pytest.approx(before + 0.25, abs=1e-5)


@pytest.mark.parametrize("kind", ENGINES)
def test_progress_counts_images_and_nothing_gives_nothing(kind: str) -> None:
    made, seen = make_engine(kind, make_network(4, "ccpccp")), []
    made.run(make_images(70), "values", lambda done, of: seen.append((done, of)))
    size = 4 if kind == "torch" else 32
    assert seen == [(min(done, 70), 70) for done in range(size, 70 + size, size)]
    assert made.run(make_images(0), "values").shape == (0, 3)
    assert made.run(make_images(0), "sums").shape == (0, 16)


@pytest.mark.parametrize("kind", ENGINES)
def test_a_network_without_sixteen_blocks_has_values_but_no_sums(kind: str) -> None:
    made = make_engine(kind, make_network(5, "ccpccp"))
    assert made.run(make_images(2), "values").shape == (2, 3)
    with pytest.raises(ValueError, match="filters must divide 16"):
        made.run(make_images(2), "sums")


@pytest.mark.parametrize("kind", ENGINES)
def test_read_only_images_are_taken(kind: str) -> None:
    images = np.frombuffer(make_images(4).tobytes(), np.uint8).reshape(4, 50, 75)
    assert make_engine(kind, make_network(16, "ccpccp")).run(images, "values").shape == (4, 3)
