"""Write a network whose outputs are the same for every image, in the layout of any exporter."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper


def write_network(
    path: Path,
    outputs: Mapping[str, NDArray],
    metadata: Mapping[str, str],
    inputs: Mapping[str, tuple[int, list[int | str]]] | None = None,
    opset: int = 13,
) -> Path:
    """Write a model with these constant outputs. inputs: type and shape by name; by default one float image of 64."""
    ports = inputs or {"images": (TensorProto.FLOAT, [1, 3, 64, 64])}
    kept = {name: np.asarray(array) for name, array in outputs.items()}
    graph = helper.make_graph(
        [helper.make_node("Identity", [f"{name}_constant"], [name]) for name in kept],
        "constant",
        [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in ports.items()],
        [
            helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(array.dtype), list(array.shape))
            for name, array in kept.items()
        ],
        [numpy_helper.from_array(array, f"{name}_constant") for name, array in kept.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    helper.set_model_props(model, dict(metadata))
    onnx.save(model, str(path))
    return path
