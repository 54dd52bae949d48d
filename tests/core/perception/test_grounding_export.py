"""A tiny random Grounding DINO: the exported file equals torch to 1e-4."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from tiny_grounding import TinyTokenizer

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.perception.box_size import BoxSizeLimits
from gausslite.perception.grounding import INPUTS, OUTPUTS, GroundingDino, GroundingSettings, preprocess
from gausslite.perception.grounding_text import encode_phrase
from gausslite.perception.models.model_file import open_model

torch = pytest.importorskip("torch", reason="the reference extra brings torch, which this network is made with")
transformers = pytest.importorskip("transformers", reason="transformers, which has Grounding DINO, is not installed")

HEIGHT_PX, WIDTH_PX, TOKENS = 64, 96, 5
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

    class WithNamedInputs(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.model = model

        def forward(self, *inputs):
            result = self.model(**dict(zip(INPUTS, inputs, strict=True)))
            return result.logits, result.pred_boxes

    return WithNamedInputs().eval()


@pytest.fixture(scope="module")
def path(network, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("grounding") / "tiny.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            torch.onnx.export(
                network, network_inputs(0, "red mug"), str(file), opset_version=17, dynamo=False,
                input_names=list(INPUTS), output_names=list(OUTPUTS),
            )  # fmt: skip
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
    lenient = GroundingSettings(0.001, 0.001, nms_max_iou=0.999, box_limits=BoxSizeLimits(1e6, 1e6, 1e6, 1.0, 1.0, 1.0))
    detector = GroundingDino(open_model(path, 1), TinyTokenizer(), lenient)
    text = encode_phrase(phrase, TinyTokenizer(), TOKENS)
    for seed in SEEDS:
        frame = Frame(0, 0, rgb(seed), np.ones((48, 96), np.float32), Camera(90, 90, 48, 24, 96, 48), np.eye(4))
        found = detector.boxes(frame, [phrase])
        with torch.no_grad():
            logits, boxes = (each[0].numpy() for each in network(*network_inputs(seed, phrase)))
        likely = 1 / (1 + np.exp(-logits))
        sure = likely.max(axis=1) >= 0.001
        sure &= likely[:, : len(text.is_noun)][:, list(text.is_noun)].max(axis=1) >= 0.001
        corners = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)
        expected = np.clip(corners * (96, 48, 96, 48), 0, (96, 48, 96, 48))[sure]
        order = np.argsort(-likely.max(axis=1)[sure])
        assert len(found) == len(expected) > 6
        np.testing.assert_allclose([box.score for box in found], likely.max(axis=1)[sure][order], atol=1e-4)
        np.testing.assert_allclose([box.box_px for box in found], expected[order], atol=1e-4 * 96)
