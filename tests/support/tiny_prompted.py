"""Minimal networks with text features as an input, a CLIP-like text encoder and its tokenizer, with known results."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIDE_PX = 64
DIMENSIONS = 8
WORDS = ("[PAD]", "<|startoftext|>", "<|endoftext|>", "[UNK]", "mug", "cup", "red", "chair", "object")


def write_prompted(
    path: Path,
    boxes_cxcywh: Sequence[tuple[float, float, float, float]],
    anchors: np.ndarray,
    classes: int | str = "classes",
    splits: bool = False,
) -> Path:
    """Write a network with score = sigmoid(text · anchor) · the image's mean red; anchors f32[A, DIMENSIONS].

    classes: number of text features, or the name of a dynamic size. splits: corners and scores as two outputs.
    """
    centre = np.array([boxes_cxcywh], np.float32)
    corners = np.concatenate([centre[..., :2] - centre[..., 2:] / 2, centre[..., :2] + centre[..., 2:] / 2], axis=-1)
    constants = {
        "rows": centre.transpose(0, 2, 1),
        "corners": corners,
        "anchors": anchors.astype(np.float32).T,
        "zero": np.array([0], np.int64),
        "one": np.array([1], np.int64),
    }
    nodes = [
        helper.make_node("Slice", ["images", "zero", "one", "one"], ["red"]),
        helper.make_node("ReduceMean", ["red"], ["mean_red"], axes=[2, 3], keepdims=1),
        helper.make_node("Squeeze", ["mean_red", "one"], ["brightness"]),
        helper.make_node("MatMul", ["txt_feats", "anchors"], ["logits"]),
        helper.make_node("Sigmoid", ["logits"], ["probabilities"]),
        helper.make_node("Mul", ["probabilities", "brightness"], ["class_scores"]),
    ]
    count = len(boxes_cxcywh)
    if splits:
        nodes += [
            helper.make_node("Transpose", ["class_scores"], ["scores"], perm=[0, 2, 1]),
            helper.make_node("Identity", ["corners"], ["boxes"]),
        ]
        shapes = {"scores": [1, count, classes], "boxes": [1, count, 4]}
    else:
        nodes.append(helper.make_node("Concat", ["rows", "class_scores"], ["output0"], axis=1))
        shapes = {"output0": [1, "channels" if isinstance(classes, str) else 4 + classes, count]}
    inputs = {"images": [1, 3, SIDE_PX, SIDE_PX], "txt_feats": [1, classes, DIMENSIONS]}
    return _save(path, nodes, _float_ports(inputs), _float_ports(shapes), constants)


def word_vectors() -> np.ndarray:
    """Return the token embeddings of the tiny text encoder, f32[words, DIMENSIONS]."""
    return np.random.default_rng(5).standard_normal((len(WORDS), DIMENSIONS)).astype(np.float32)


def write_text_encoder(
    path: Path, rows: int | str = "n", output: str = "text_embeds", has_attention: bool = False
) -> Path:
    """Write an encoder from token ids [rows, 77] to the sum of their embeddings [rows, DIMENSIONS], pads left out."""
    constants = {"vectors": word_vectors() * (np.arange(len(WORDS)) > 0)[:, None].astype(np.float32)}
    nodes = [helper.make_node("Gather", ["vectors", "input_ids"], ["tokens"])]
    inputs = [helper.make_tensor_value_info("input_ids", TensorProto.INT64, [rows, 77])]
    summed = "tokens"
    if has_attention:
        inputs.append(helper.make_tensor_value_info("attention_mask", TensorProto.INT64, [rows, 77]))
        constants["last"] = np.array([2], np.int64)
        nodes += [
            helper.make_node("Cast", ["attention_mask"], ["weights"], to=TensorProto.FLOAT),
            helper.make_node("Unsqueeze", ["weights", "last"], ["weights_3"]),
            helper.make_node("Mul", ["tokens", "weights_3"], ["weighted"]),
        ]
        summed = "weighted"
    constants["axis"] = np.array([1], np.int64)
    nodes.append(helper.make_node("ReduceSum", [summed, "axis"], [output], keepdims=0))
    outputs = [helper.make_tensor_value_info(output, TensorProto.FLOAT, [rows, DIMENSIONS])]
    return _save(path, nodes, inputs, outputs, constants)


def write_tokenizer(path: Path) -> Path:
    """Write a tokenizer of whole words with CLIP's start and end tokens, in the JSON format of `tokenizers`."""
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace
    from tokenizers.processors import TemplateProcessing

    tokenizer = Tokenizer(WordLevel({word: index for index, word in enumerate(WORDS)}, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = Whitespace()
    tokenizer.post_processor = TemplateProcessing(
        single="<|startoftext|> $A <|endoftext|>", special_tokens=[("<|startoftext|>", 1), ("<|endoftext|>", 2)]
    )
    tokenizer.save(str(path))
    return path


def _float_ports(shapes: dict[str, list[int | str]]) -> list[onnx.ValueInfoProto]:
    return [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]


def _save(path: Path, nodes, inputs, outputs, constants: dict[str, np.ndarray]) -> Path:
    initialisers = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initialisers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path
