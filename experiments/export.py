"""What a run leaves behind, for other programs: its network as ONNX, its memory as Parquet ..."""

import io
import json
import math
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import pyarrow as pa
from onnx import TensorProto, helper, numpy_helper
from PIL import Image
from pyarrow import parquet

from services.commander import bundle
from services.replay.tables import Tables
from shared.errors import ConfigError, StateError
from shared.facts import ACTIONS, IMAGE_SHAPE
from shared.provenance import BUNDLE
from shared.rl.memory import PART, Images, ReplayMemory
from shared.rl.network import HIDDEN, QNetwork, load_bytes
from shared.run_record import read_episodes

OPSET, IR_VERSION = helper.make_opsetid("", 17), 8
"""Old enough for every runtime of the last years."""
TOLERANCE = 1e-5
"""Predictions of the ONNX file may differ by this from ours."""
CHECKED = 1000
"""Images that an export is checked with."""


def weights(run: Path, out: Path) -> str:
    """Write the network of a run as ONNX: images uint8 [n, 50, 75] in, values [n, actions] out.

    Raises StateError when it predicts something else than ours.
    """
    found, made = bundle.described(run)
    network = QNetwork(made.network)
    load_bytes(network, found.data)
    model = _graph(network)
    helper.set_model_props(model, {BUNDLE: made.model_dump_json()})
    onnx.checker.check_model(model, full_check=True)
    images = np.random.default_rng(0).integers(0, 256, (CHECKED, *IMAGE_SHAPE), np.uint8)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    predicted = session.run(None, {"images": images})[0]
    most = float(np.abs(predicted - found.predictor(made.network).all_values(images)).max())
    if not most <= TOLERANCE:
        raise StateError(f"{run}: as ONNX it predicts {most:.1e} beside what it should")
    onnx.save(model, out)
    return f"predictions equal within {most:.1e}"


def memory(run: Path, out: Path) -> str:
    """Write the replay memory of a run as Parquet: a sample a row, images as PNG."""
    samples, tables = ReplayMemory(1), Tables(run / "replay", readonly=True)
    with closing(tables.env):
        tables.update(samples)
    if not len(samples):
        raise StateError(f"{run}: the replay memory is empty")
    names = [name for name in samples.rows.dtype.names or () if name != "slot"]
    columns = {name: _column(samples.rows[name]) for name in names}
    columns["world"] = pa.array([samples.worlds[i] for i in samples.rows["world"]])
    parts = (images for _, images in samples.parts(np.arange(len(samples))))
    columns["image"] = pa.array([_png(i) for part in parts for i in part], pa.large_binary())
    actions = json.dumps([action.name for action in ACTIONS])
    table = pa.table(columns).replace_schema_metadata({"actions": actions})
    parquet.write_table(table, out, row_group_size=PART, compression="zstd")
    return f"{len(samples)} samples of {', '.join(samples.worlds)}"


def metrics(run: Path, out: Path) -> str:
    """Write `episodes.csv`, joined with `training.csv`, as Parquet."""
    rows = read_episodes(run)
    if not rows:
        raise StateError(f"{run}: no episode was recorded")
    columns = {name: _numbers([row.get(name, "") for row in rows]) for name in rows[0]}
    parquet.write_table(pa.table(columns), out, compression="zstd")
    return f"{len(rows)} episodes, {len(columns)} columns"


EXPORTS = {"weights": weights, "memory": memory, "metrics": metrics}


def write(what: str, run: Path, out: Path) -> str:
    """Write one of `EXPORTS`; returns a line about it. Raises ConfigError or StateError."""
    if what not in EXPORTS:
        raise ConfigError(f"expected one of {', '.join(EXPORTS)}, got {what!r}")
    if out.exists():
        raise ConfigError(f"--out: {out} exists already")
    return f"{out}: {EXPORTS[what](run, out)}"


def _column(values: npt.NDArray[Any]) -> pa.Array:
    """One value of every sample; what is itself an array becomes a list."""
    flat = pa.array(np.ascontiguousarray(values).ravel())
    shape = values.shape[1:]
    return pa.FixedSizeListArray.from_arrays(flat, math.prod(shape)) if shape else flat


def _png(image: Images) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


def _numbers(texts: list[str]) -> pa.Array:
    """A column as whole numbers, else as numbers, else as text; empty fields are null."""
    kinds: tuple[Callable[[str], Any], ...] = (int, float, str)
    for kind in kinds:
        with suppress(ValueError):
            return pa.array([kind(text) if text else None for text in texts])
    raise AssertionError("text is always text")


def _graph(network: QNetwork) -> onnx.ModelProto:
    """The network (Fig 3.6). What depends on the action alone is computed here, once for all."""
    p = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    encoded = network.action_vectors.numpy() @ p["fconn2.weight"].T + p["fconn2.bias"]
    of_image, of_action = np.hsplit(p["fconn3.weight"], [HIDDEN])
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def add(op: str, *values: npt.ArrayLike, **attributes: Any) -> None:
        """A node after the last one; the values are constants."""
        inputs = [nodes[-1].output[0] if nodes else "images"]
        after = "values" if op == "Clip" else f"{op}-{len(nodes)}"
        for value in values:
            inputs.append(f"constant-{len(constants)}")
            constants.append(numpy_helper.from_array(np.asarray(value), inputs[-1]))
        nodes.append(helper.make_node(op, inputs, [after], **attributes))

    add("Cast", to=TensorProto.FLOAT)
    add("Div", np.float32(255))
    add("Unsqueeze", [1])
    for number, pooled in enumerate(network.pooled, start=1):
        add("Conv", p[f"conv{number}.weight"], p[f"conv{number}.bias"])
        if pooled:
            add("MaxPool", kernel_shape=[2, 2], strides=[2, 2])
        add("Relu")
    add("Flatten")
    add("Gemm", p["fconn1.weight"], p["fconn1.bias"], transB=1)
    add("Relu")
    add("MatMul", of_image.T)
    add("Unsqueeze", [1])
    add("Add", np.maximum(encoded, 0) @ of_action.T + p["fconn3.bias"])
    add("Relu")
    add("MatMul", p["out.weight"].T)
    add("Squeeze", [2])
    add("Add", p["out.bias"])
    add("Clip", np.float32(-1), np.float32(1))
    images = helper.make_tensor_value_info("images", TensorProto.UINT8, ["n", *IMAGE_SHAPE])
    values = helper.make_tensor_value_info("values", TensorProto.FLOAT, ["n", len(ACTIONS)])
    graph = helper.make_graph(nodes, "corridor", [images], [values], constants)
    return helper.make_model(graph, opset_imports=[OPSET], ir_version=IR_VERSION)
