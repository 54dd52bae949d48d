"""A minimal network with known results and the inputs and outputs of Grounding DINO.

The boxes are constant. Each box has a logit per word, so the result depends on the words of the phrase. Tokens outside
the attention mask are at -inf, as in the real network. The blue channel's mean over the masked pixels is added to
every logit, so the result also depends on the image and the pixel mask.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from gausslite_detectors.text_features import WordPieces

VOCABULARY = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", ".", "red", "mug", "table", "mu", "##g", "object")
_UNSURE = -6.0

BoxLogits = tuple[tuple[float, float, float, float], Mapping[str, float]]
"""A box (centre x, y, width, height, in shares of the image) and its logit for each word."""


class TinyTokenizer:
    """A tokenizer of whole words that does not need the package `tokenizers`."""

    def encode(self, text: str) -> WordPieces:
        ids, spans, at = [], [], 0
        for word in text.split():
            at = text.index(word, at)
            ids.append(VOCABULARY.index(word) if word in VOCABULARY else 1)
            spans.append((at, at + len(word)))
            at += len(word)
        return WordPieces(tuple(ids), tuple(spans))

    def special_token_id(self, name: str) -> int:
        return VOCABULARY.index(name)


def write_tiny_grounding(
    path: Path,
    box_logits: Sequence[BoxLogits],
    size_px: tuple[int | str, int | str] = (48, 64),
    length: int | str = 8,
    pixel_mask: bool = True,
) -> Path:
    """Write a model with these constant boxes; a size or length given as a name is dynamic."""
    logits = np.full((len(box_logits), len(VOCABULARY)), _UNSURE, np.float32)
    for row, (_, words) in enumerate(box_logits):
        for word, logit in words.items():
            logits[row, VOCABULARY.index(word)] = logit
    constants = {
        "table": logits,
        "boxes": np.array([[box for box, _ in box_logits]], np.float32).reshape(1, -1, 4),
        "never": np.array(-np.inf, np.float32),
        "blue": np.array([2], np.int64),
        "blue_end": np.array([3], np.int64),
        "one": np.array([1], np.int64),
    }
    nodes = [
        helper.make_node("Gather", ["table", "input_ids"], ["by_token"], axis=1),
        helper.make_node("Transpose", ["by_token"], ["known"], perm=[1, 0, 2]),
        helper.make_node("Slice", ["pixel_values", "blue", "blue_end", "one"], ["blue_channel"]),
        *_mean_blue(pixel_mask),
        helper.make_node("Add", ["known", "mean_blue"], ["lit"]),
        helper.make_node("Cast", ["attention_mask"], ["attended"], to=TensorProto.BOOL),
        helper.make_node("Unsqueeze", ["attended", "one"], ["attended_3d"]),
        helper.make_node("Where", ["attended_3d", "lit", "never"], ["shown"]),
        helper.make_node("Identity", ["shown"], ["logits"]),
        helper.make_node("Identity", ["boxes"], ["pred_boxes"]),
    ]
    image, text = [1, 3, *size_px], [1, length]
    inputs = [("pixel_values", TensorProto.FLOAT, image), ("input_ids", TensorProto.INT64, text)]
    inputs += [(name, TensorProto.INT64, text) for name in ("attention_mask", "token_type_ids")]
    inputs += [("pixel_mask", TensorProto.INT64, [1, *size_px])] if pixel_mask else []
    graph = helper.make_graph(
        nodes,
        "tiny_grounding",
        [helper.make_tensor_value_info(*each) for each in inputs],
        [
            helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, len(box_logits), length]),
            helper.make_tensor_value_info("pred_boxes", TensorProto.FLOAT, [1, len(box_logits), 4]),
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), str(path))
    return path


def _mean_blue(pixel_mask: bool) -> list[onnx.NodeProto]:
    if not pixel_mask:
        return [helper.make_node("ReduceMean", ["blue_channel"], ["mean_blue"], axes=[1, 2, 3], keepdims=0)]
    return [
        helper.make_node("Cast", ["pixel_mask"], ["mask"], to=TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["mask", "one"], ["mask_4d"]),
        helper.make_node("Mul", ["blue_channel", "mask_4d"], ["masked"]),
        helper.make_node("ReduceSum", ["masked"], ["sum_blue"], keepdims=0),
        helper.make_node("ReduceSum", ["mask"], ["count"], keepdims=0),
        helper.make_node("Div", ["sum_blue", "count"], ["mean_blue"]),
    ]
