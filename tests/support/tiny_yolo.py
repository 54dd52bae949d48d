"""A minimal YOLO-seg network with known results and the real inputs, outputs and metadata.

Prototype 0 is the image's red channel, averaged over 4x4 pixels; prototype 1 is one everywhere. A box with
coefficients (20, -10) therefore has its mask where red is above one half. The boxes are constants.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIDE_PX = 64
MASK_COEFFICIENTS = 32


def write_tiny_yolo(
    path: Path, names: Sequence[str], boxes: Sequence[tuple[float, float, float, float, int, float]], named: bool = True
) -> Path:
    """Write a model with these constant boxes: centre x, y, width, height, class, score."""
    output = np.zeros((1, 4 + len(names) + MASK_COEFFICIENTS, max(len(boxes), 1)), np.float32)
    for column, (x, y, width, height, index, score) in enumerate(boxes):
        output[0, :4, column] = x, y, width, height
        output[0, 4 + index, column] = score
        output[0, 4 + len(names) : 4 + len(names) + 2, column] = 20.0, -10.0
    grid = SIDE_PX // 4
    rest = np.zeros((1, MASK_COEFFICIENTS - 1, grid, grid), np.float32)
    rest[0, 0] = 1.0
    constants = {
        "boxes": output,
        "rest": rest,
        "red": np.array([0], np.int64),
        "end": np.array([1], np.int64),
        "axis": np.array([1], np.int64),
    }
    nodes = [
        helper.make_node("Identity", ["boxes"], ["output0"]),
        helper.make_node("Slice", ["images", "red", "end", "axis"], ["red_channel"]),
        helper.make_node("AveragePool", ["red_channel"], ["pooled"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Concat", ["pooled", "rest"], ["output1"], axis=1),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, SIDE_PX, SIDE_PX])],
        [
            helper.make_tensor_value_info("output0", TensorProto.FLOAT, list(output.shape)),
            helper.make_tensor_value_info("output1", TensorProto.FLOAT, [1, MASK_COEFFICIENTS, grid, grid]),
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {"names": str(dict(enumerate(names)))} if named else {})
    onnx.save(model, str(path))
    return path


def write_boxes_only(
    path: Path, names: Sequence[str], boxes: Sequence[tuple[float, float, float, float, int, float]], more_rows: int = 0
) -> Path:
    """Write a detector with these constant boxes and without masks: [1, 4+c, A], after it more_rows of zeros."""
    output = np.zeros((1, 4 + len(names) + more_rows, len(boxes)), np.float32)
    for column, (x, y, width, height, index, score) in enumerate(boxes):
        output[0, :4, column] = x, y, width, height
        output[0, 4 + index, column] = score
    graph = helper.make_graph(
        [helper.make_node("Identity", ["boxes"], ["output0"])],
        "boxes_only",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, SIDE_PX, SIDE_PX])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, list(output.shape))],
        [numpy_helper.from_array(output, "boxes")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {"names": str(dict(enumerate(names)))})
    onnx.save(model, str(path))
    return path
