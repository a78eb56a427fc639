"""The Q network against a forward pass in plain numpy (A21-A24, E8, E16), and its predictions."""

from __future__ import annotations

import json
import math
from typing import Literal

import numpy as np
import pytest
import torch
from builders import make_images
from safetensors.torch import save

from shared.config import NetworkConfig, Numerics
from shared.rl.engine import network_input
from shared.rl.network import (
    QNetwork,
    checked,
    initialised,
    load_bytes,
    parameter_count,
    to_bytes,
    weights_hash,
)
from shared.rl.predictor import Predictor

torch.set_num_threads(1)
Layout = Literal["ccpccp", "cpcccp"]
LAYOUTS: tuple[Layout, ...] = ("ccpccp", "cpcccp")
ACTIONS = ((1, 0, 0), (1, 1, 0), (1, 0, 1))
SMALL = NetworkConfig(filters=4)


def convolved(x: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """3x3, stride 1, no padding, then ReLU: [c, h, w] to [d, h - 2, w - 2]."""
    height, width = x.shape[1] - 2, x.shape[2] - 2
    out = np.zeros((len(weight), height, width)) + bias[:, None, None]
    for dy in range(3):
        for dx in range(3):
            part = x[:, dy : dy + height, dx : dx + width]
            out += np.einsum("dc,chw->dhw", weight[:, :, dy, dx], part)
    return np.maximum(out, 0.0)


def pooled(x: np.ndarray) -> np.ndarray:
    """2x2 maxima; an odd last row or column is left out."""
    height, width = x.shape[1] // 2, x.shape[2] // 2
    out = np.zeros((len(x), height, width))
    for i in range(height):
        for j in range(width):
            out[:, i, j] = x[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max(axis=(1, 2))
    return out


def naive_q(network: QNetwork, image: np.ndarray, action: int) -> tuple[np.ndarray, float]:
    """MaxPool2 map and unclipped Q of one image, following Fig 3.6 layer by layer."""
    p = {name: t.detach().double().numpy() for name, t in network.state_dict().items()}
    x = image[None].astype(np.float64) / 255.0
    number = 0
    for layer in network.layout:
        if layer == "c":
            number += 1
            x = convolved(x, p[f"conv{number}.weight"], p[f"conv{number}.bias"])
        else:
            x = pooled(x)
    state = np.maximum(p["fconn1.weight"] @ x.flatten() + p["fconn1.bias"], 0)
    command = np.maximum(p["fconn2.weight"] @ np.array(ACTIONS[action]) + p["fconn2.bias"], 0)
    joined = np.concatenate([state, command])
    hidden = np.maximum(p["fconn3.weight"] @ joined + p["fconn3.bias"], 0)
    return x, float((p["out.weight"] @ hidden + p["out.bias"])[0])


def make_network(config: NetworkConfig, seed: int = 3) -> QNetwork:
    """Weights as at the start, but biases that are not zero, so that they count."""
    network = initialised(config, seed)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if name.endswith("bias"):
                parameter.copy_(torch.linspace(-0.1, 0.2, parameter.numel()))
    return network


# ------------------------------------------------------------------------- shape


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_network_of_the_thesis_has_1238337_parameters_and_64x9x15_maps(layout: Layout) -> None:
    network = QNetwork(NetworkConfig(filters=64, layout=layout))
    assert parameter_count(network) == 1_238_337
    with torch.no_grad():
        maps = network.maps(torch.zeros((2, 1, 50, 75)))
        assert maps.shape == (2, 64, 9, 15)
        assert network.all_values(maps).shape == (2, 3)


def test_layers_are_those_of_the_figure() -> None:
    shapes = {n: tuple(t.shape) for n, t in QNetwork(NetworkConfig()).state_dict().items()}
    assert shapes == {
        "conv1.weight": (64, 1, 3, 3),
        "conv1.bias": (64,),
        **{f"conv{i}.weight": (64, 64, 3, 3) for i in (2, 3, 4)},
        **{f"conv{i}.bias": (64,) for i in (2, 3, 4)},
        "fconn1.weight": (128, 64 * 9 * 15),
        "fconn1.bias": (128,),
        "fconn2.weight": (32, 3),
        "fconn2.bias": (32,),
        "fconn3.weight": (128, 160),
        "fconn3.bias": (128,),
        "out.weight": (1, 128),
        "out.bias": (1,),
    }


@pytest.mark.parametrize("layout", LAYOUTS)
def test_forward_pass_equals_the_one_in_numpy(layout: Layout) -> None:
    network = make_network(NetworkConfig(filters=4, layout=layout))
    images = make_images(2, seed=1)
    with torch.no_grad():
        maps = network.maps(network_input(images, "cpu"))
        every = network.all_values(maps)
        for i, image in enumerate(images):
            for action in range(3):
                naive_map, q = naive_q(network, image, action)
                single = network.values(maps[i : i + 1], torch.tensor([action]))
                assert maps[i].numpy() == pytest.approx(naive_map, abs=1e-5)
                assert float(single) == pytest.approx(q, abs=1e-5)
                assert float(every[i, action]) == pytest.approx(q, abs=1e-5)


def test_values_take_each_image_with_its_own_action() -> None:
    network = make_network(SMALL)
    with torch.no_grad():
        maps = network.maps(network_input(make_images(3), "cpu"))
        actions = torch.tensor([2, 0, 1])
        expected = network.all_values(maps)[torch.arange(3), actions]
        assert network.values(maps, actions).numpy() == pytest.approx(expected.numpy(), abs=1e-6)


# ------------------------------------------------------------------------- initial weights


def test_initial_weights_are_glorot_uniform_and_biases_zero() -> None:
    network = initialised(NetworkConfig(filters=16), seed=9)
    fans = {
        "conv1.weight": (1 * 9, 16 * 9),
        "conv2.weight": (16 * 9, 16 * 9),
        "conv3.weight": (16 * 9, 16 * 9),
        "conv4.weight": (16 * 9, 16 * 9),
        "fconn1.weight": (16 * 135, 128),
        "fconn2.weight": (3, 32),
        "fconn3.weight": (160, 128),
        "out.weight": (128, 1),
    }
    for name, parameter in network.named_parameters():
        values = parameter.detach().numpy().flatten()
        if name.endswith("bias"):
            assert not values.any()
            continue
        bound = math.sqrt(6.0 / sum(fans[name]))
        assert abs(values).max() <= bound * (1 + 1e-6)
        assert abs(values).max() > 0.9 * bound
        assert abs(values.mean()) < 5 * bound / math.sqrt(3 * len(values))
        assert values.std() == pytest.approx(bound / math.sqrt(3), rel=0.2)


def test_initial_weights_are_a_function_of_the_seed() -> None:
    assert to_bytes(initialised(SMALL, 1)) == to_bytes(initialised(SMALL, 1))
    assert to_bytes(initialised(SMALL, 1)) != to_bytes(initialised(SMALL, 2))


# ------------------------------------------------------------------------- bytes


def test_weights_survive_the_way_through_bytes() -> None:
    source, target = make_network(SMALL, 1), make_network(SMALL, 2)
    data = to_bytes(source)
    load_bytes(target, data)
    assert to_bytes(target) == data
    assert weights_hash(data) == weights_hash(to_bytes(source))
    assert weights_hash(data) != weights_hash(data[:-1])
    assert len(weights_hash(data)) == 16


def tensors(seed: int = 5) -> dict[str, torch.Tensor]:
    return {n: t.clone().contiguous() for n, t in make_network(SMALL, seed).state_dict().items()}


def damaged(kind: str) -> bytes:
    good = tensors()
    if kind == "NaN":
        good["conv2.bias"][1] = math.nan
    elif kind == "infinite":
        good["out.bias"][0] = math.inf
    elif kind == "missing":
        del good["out.bias"]
    elif kind == "extra":
        good["more"] = torch.zeros(1)
    elif kind == "double":
        good["out.bias"] = good["out.bias"].double()
    elif kind == "half":
        good["out.weight"] = good["out.weight"].half()
    elif kind == "transposed":
        good["fconn2.weight"] = good["fconn2.weight"].T.contiguous()
    elif kind == "wider network":
        good = {
            n: t.contiguous() for n, t in QNetwork(NetworkConfig(filters=8)).state_dict().items()
        }
    data = save(good)
    return {
        "truncated": data[:-3],
        "empty": b"",
        "garbage": b"\x80\x04pickle" * 20,
        "huge header": (2**63).to_bytes(8, "little") + data[8:],
    }.get(kind, data)


@pytest.mark.parametrize(
    "kind",
    [
        *("NaN", "infinite", "missing", "extra", "double", "half", "transposed", "wider network"),
        *("truncated", "empty", "garbage", "huge header"),
    ],
)
def test_bad_weights_are_refused_and_leave_the_network_as_it_was(kind: str) -> None:
    network = make_network(SMALL, 1)
    before = to_bytes(network)
    with pytest.raises(ValueError, match="weights: "):
        load_bytes(network, damaged(kind))
    assert to_bytes(network) == before


def test_weights_say_what_network_they_are_of_and_another_one_refuses_them() -> None:
    """Both layouts have the same tensors, and mean something else by them."""
    data = to_bytes(make_network(SMALL))
    twin = QNetwork(SMALL.model_copy(update={"layout": "cpcccp"}))
    assert twin.state_dict().keys() == make_network(SMALL).state_dict().keys()
    for take in (load_bytes, checked):
        with pytest.raises(ValueError, match=r"weights: expected those of .*cpcccp.*got .*ccpccp"):
            take(twin, data)
    told = json.loads(safetensors_metadata(data)["network"])
    assert told == {
        "actions": [[1, 0, 0], [1, 1, 0], [1, 0, 1]],
        "filters": SMALL.filters,
        "image": [50, 75],
        "layout": "ccpccp",
        "white": 255,
    }


def safetensors_metadata(data: bytes) -> dict[str, str]:
    header: dict[str, dict[str, str]] = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return header["__metadata__"]


def test_files_without_metadata_can_be_read_but_are_not_taken_from_the_bus() -> None:
    network, data = make_network(SMALL, 1), save(tensors())
    load_bytes(network, data)
    with pytest.raises(ValueError, match=r"weights: expected those of .*, got None"):
        checked(network, data)


def test_a_check_needs_names_and_shapes_only_and_changes_nothing() -> None:
    with torch.device("meta"):
        hollow = QNetwork(SMALL)
    found = checked(hollow, to_bytes(make_network(SMALL, 1)))
    assert found.keys() == hollow.state_dict().keys()
    with pytest.raises(ValueError, match="weights: at most"):
        checked(hollow, to_bytes(make_network(SMALL, 1)) + bytes(70_000))


def test_too_many_bytes_are_refused_unread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared.rl.network.MAX_WEIGHT_BYTES", 100)
    with pytest.raises(ValueError, match="at most 100 bytes"):
        load_bytes(make_network(SMALL), to_bytes(make_network(SMALL)))


# ------------------------------------------------------------------------- Predictor


def make_predictor(
    config: NetworkConfig = SMALL,
    *,
    batch: int = 4,
    precision: Literal["float32", "bfloat16"] = "float32",
    out_bias: float = 0.0,
) -> Predictor:
    network = make_network(config)
    with torch.no_grad():
        network.out.bias.fill_(out_bias)
    predictor = Predictor(config, Numerics(batch=batch, precision=precision))
    predictor.load(7, to_bytes(network))
    return predictor


@pytest.mark.parametrize("batch", [1, 3, 4, 8, 32])
@pytest.mark.parametrize("filters", [4, 16])
def test_a_prediction_does_not_depend_on_how_many_others_are_asked(
    batch: int, filters: int
) -> None:
    """Bit for bit: a pass has always the same shape, and rows do not see each other."""
    predictor = make_predictor(NetworkConfig(filters=filters), batch=batch)
    images, others = make_images(9, seed=4), make_images(9, seed=5)
    values, descriptors = predictor.all_values(images), predictor.descriptors(images)
    for n in range(1, 9):
        assert predictor.all_values(images[:n]).tobytes() == values[:n].tobytes()
        assert predictor.descriptors(images[:n]).tobytes() == descriptors[:n].tobytes()
        mixed = np.concatenate([images[:n], others[n:]])
        assert predictor.all_values(mixed)[:n].tobytes() == values[:n].tobytes()


def test_one_observation_per_pass_is_predicted_the_same_alone_and_in_a_row() -> None:
    predictor, images = make_predictor(batch=1), make_images(5)
    alone = [predictor.all_values(image[None])[0].tobytes() for image in images]
    assert [v.tobytes() for v in predictor.all_values(images)] == alone


@pytest.mark.parametrize("bias", [-50.0, 0.0, 50.0])
def test_predictions_are_clipped_and_equal_the_network_inside_the_range(bias: float) -> None:
    predictor, network = make_predictor(out_bias=bias), make_network(SMALL)
    with torch.no_grad():
        network.out.bias.fill_(bias)
    images = make_images(2)
    for image, found in zip(images, predictor.all_values(images), strict=True):
        expected = [naive_q(network, image, a)[1] for a in range(3)]
        assert list(found) == pytest.approx(np.clip(expected, -1.0, 1.0), abs=1e-5)


def test_the_network_itself_is_not_clipped() -> None:
    network = make_network(SMALL)
    with torch.no_grad():
        network.out.bias.fill_(50.0)
        maps = network.maps(network_input(make_images(1), "cpu"))
        assert float(network.values(maps, torch.tensor([0]))) > 40.0


def test_values_are_those_of_the_given_actions() -> None:
    predictor = make_predictor()
    images, actions = make_images(5), np.array([0, 2, 1, 2, 0], np.uint8)
    every = predictor.all_values(images)
    assert list(predictor.values(images, actions)) == [every[i, a] for i, a in enumerate(actions)]


def test_nothing_asked_nothing_told() -> None:
    predictor, none = make_predictor(), np.zeros((0, 50, 75), np.uint8)
    assert predictor.all_values(none).shape == (0, 3)
    assert predictor.values(none, np.zeros(0, np.uint8)).shape == (0,)
    assert predictor.descriptors(none).shape == (0, 15)


def test_progress_counts_images() -> None:
    predictor, seen = make_predictor(batch=4), []
    predictor.all_values(make_images(9), lambda done, of: seen.append((done, of)))
    assert seen == [(4, 9), (8, 9), (9, 9)]


def test_descriptors_come_from_the_maps_of_the_image() -> None:
    predictor, network = (
        make_predictor(NetworkConfig(filters=16)),
        make_network(NetworkConfig(filters=16)),
    )
    (image,) = make_images(1, seed=8)
    maps, _ = naive_q(network, image, 0)
    sums = [float(channel.sum()) for channel in maps]
    bits = [int(sums[i] > sums[j]) for i in range(16) for j in range(i + 1, 16)]
    assert list(np.unpackbits(predictor.descriptors(image[None])[0])) == bits


def test_reduced_precision_is_close_to_full_precision() -> None:
    images = make_images(6, seed=2)
    full = make_predictor(NetworkConfig(filters=16)).all_values(images)
    reduced = make_predictor(NetworkConfig(filters=16), precision="bfloat16").all_values(images)
    assert reduced.dtype == np.float32
    assert not np.array_equal(full, reduced)
    assert reduced == pytest.approx(full, abs=0.03)


def test_a_refused_version_leaves_the_predictor_at_the_old_one() -> None:
    predictor, images = make_predictor(), make_images(1)
    before = (predictor.version, predictor.all_values(images).tobytes())
    with pytest.raises(ValueError, match="not finite"):
        predictor.load(8, damaged("NaN"))
    assert (predictor.version, predictor.all_values(images).tobytes()) == before


def test_a_loaded_version_is_named_by_its_number() -> None:
    predictor, data = make_predictor(), save(tensors(6))
    predictor.load(9, data)
    assert predictor.version == 9


def test_a_successor_predicts_with_other_weights_and_leaves_the_first_alone() -> None:
    first, images = make_predictor(), make_images(2)
    before = first.all_values(images)
    second = first.successor(9, save(tensors(6)))
    assert (first.version, second.version) == (7, 9)
    assert np.array_equal(first.all_values(images), before)
    assert not np.array_equal(second.all_values(images), before)


def test_read_only_images_as_received_from_the_bus_are_fine() -> None:
    images = np.frombuffer(make_images(2).tobytes(), np.uint8).reshape(2, 50, 75)
    assert make_predictor().all_values(images).shape == (2, 3)
