"""Small random Grounding DINO and CLIP text encoder: the files that tools/export_model.py writes equal torch."""

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_grounding import TinyTokenizer
from tool_modules import load_tool

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite_detectors.boxes import BoxSizeLimits
from gausslite_detectors.model_file import open_model
from gausslite_detectors.open_vocabulary import INPUTS, GroundingDino, GroundingSettings, preprocess
from gausslite_detectors.text_features import encode_phrase, open_phrase_vectors

torch = pytest.importorskip("torch", reason="the reference extra brings torch, which this network is made with")
transformers = pytest.importorskip("transformers", reason="transformers, which has Grounding DINO, is not installed")

export_model = load_tool("export_model")
HEIGHT_PX, WIDTH_PX, TOKENS = 64, 96, 6
SEEDS = range(3)


@pytest.fixture(scope="module")
def network():
    """Return a network with random weights that give distinct boxes and scores."""
    config = transformers.GroundingDinoConfig(
        backbone_config=transformers.SwinConfig(
            image_size=64, embed_dim=16, depths=[1, 1, 1, 1], num_heads=[1, 2, 2, 2], window_size=4,
            out_features=["stage2", "stage3", "stage4"],
        ),
        text_config=transformers.BertConfig(
            vocab_size=64, hidden_size=32, num_hidden_layers=1, num_attention_heads=2, intermediate_size=32,
            max_position_embeddings=32,
        ),
        d_model=32, encoder_layers=1, encoder_ffn_dim=32, encoder_attention_heads=2, decoder_layers=2,
        decoder_ffn_dim=32, decoder_attention_heads=2, num_queries=12, max_text_len=16,
    )  # fmt: skip
    torch.manual_seed(0)  # for the parameters not set below
    model = transformers.GroundingDinoForObjectDetection(config).eval()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, weights in model.named_parameters():
            if weights.dim() > 1 and "embeddings" not in name:
                weights.normal_(0, weights[0].numel() ** -0.5, generator=generator)

    return model


@pytest.fixture(scope="module")
def path(network, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("grounding") / "tiny.onnx"
    try:
        ids = encode_phrase("red mug", TinyTokenizer(), None).input_ids[0].tolist()
        export_model.export_grounding_dino(network, file, (WIDTH_PX, HEIGHT_PX), ids, TOKENS)
    except torch.onnx.errors.UnsupportedOperatorError as error:
        pytest.skip(f"transformers {transformers.__version__} cannot be exported here: {str(error)[:60]}")
    return file


def rgb(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (48, 96, 3), np.uint8)


def network_inputs(seed: int, phrase: str):
    values, mask = preprocess(rgb(seed), (HEIGHT_PX, WIDTH_PX), keep_proportions=True)
    text = encode_phrase(phrase, TinyTokenizer(), TOKENS)
    given = (values, text.input_ids, text.attention_mask, text.token_type_ids, mask)
    return tuple(torch.from_numpy(each) for each in given)


@pytest.mark.parametrize("phrase", ["red mug", "table", "red table"])
def test_every_box_and_score_is_torchs(network, path, phrase):
    lenient = GroundingSettings(0.001, 0.001, nms_max_iou=0.999, box_limits=BoxSizeLimits(scale=1e6))
    detector = GroundingDino(open_model(path, 1), TinyTokenizer(), lenient)
    text = encode_phrase(phrase, TinyTokenizer(), TOKENS)
    for seed in SEEDS:
        frame = Frame(0, 0, rgb(seed), np.ones((48, 96), np.float32), Camera(90, 90, 48, 24, 96, 48), np.eye(4))
        found = detector.boxes(frame, [phrase])
        with torch.no_grad():
            result = network(**dict(zip(INPUTS, network_inputs(seed, phrase), strict=True)))
        logits, boxes = result.logits[0].numpy(), result.pred_boxes[0].numpy()
        likely = 1 / (1 + np.exp(-logits))
        sure = likely.max(axis=1) >= 0.001
        sure &= likely[:, : len(text.is_noun)][:, list(text.is_noun)].max(axis=1) >= 0.001
        corners = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)
        expected = np.clip(corners * (96, 48, 96, 48), 0, (96, 48, 96, 48))[sure]
        order = np.argsort(-likely.max(axis=1)[sure])
        assert len(found) == len(expected) > 6
        np.testing.assert_allclose([box.score for box in found], likely.max(axis=1)[sure][order], atol=1e-4)
        np.testing.assert_allclose([box.box_px for box in found], expected[order], atol=1e-4 * 96)


def test_text_features_are_torchs(tmp_path):
    pieces = ["<|startoftext|>", "<|endoftext|>", "m", "u", "g</w>", "ug</w>", "mug</w>", "r", "e", "d</w>", "ed</w>"]
    words = {piece: index for index, piece in enumerate([*pieces, "red</w>"])}
    merges = ["u g</w>", "m ug</w>", "e d</w>", "r ed</w>"]
    (tmp_path / "vocab.json").write_text(json.dumps(words), encoding="utf-8")
    (tmp_path / "merges.txt").write_text("\n".join(["#version: 0.2", *merges]), encoding="utf-8")
    checkpoint, folder = tmp_path / "checkpoint", tmp_path / "models"
    tokenizer = transformers.CLIPTokenizerFast(str(tmp_path / "vocab.json"), str(tmp_path / "merges.txt"))
    config = transformers.CLIPTextConfig(
        vocab_size=len(words), hidden_size=16, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2,
        projection_dim=8, bos_token_id=0, eos_token_id=1,
    )  # fmt: skip
    torch.manual_seed(2)
    model = transformers.CLIPTextModelWithProjection(config).eval()
    tokenizer.save_pretrained(checkpoint)
    model.save_pretrained(checkpoint)
    assert export_model.main(["text-encoder", str(checkpoint), str(folder)]) == 0
    vectors = open_phrase_vectors(folder, None, 1)
    for phrase in ("mug", "red mug", "red red mug"):
        with torch.no_grad():
            expected = model(**tokenizer(phrase, return_tensors="pt")).text_embeds[0].numpy()
        np.testing.assert_allclose(vectors.vector(phrase), expected / np.linalg.norm(expected), atol=1e-5)
    assert vectors.dimensions == 8
    assert export_model.main(["text-encoder", str(tmp_path / "missing"), str(folder)]) == 2
