#!/usr/bin/env python3
"""Export a checkpoint of Grounding DINO, or CLIP's text encoder, to the ONNX files that GaussLite reads.

    pip install "transformers<5" torch onnx
    tools/export_model.py grounding-dino IDEA-Research/grounding-dino-tiny models [--size 640x480]
    tools/export_model.py text-encoder openai/clip-vit-base-patch32 models

CHECKPOINT is a name or a folder, as `transformers` reads it. The network and its vocabulary (tokenizer) go into FOLDER.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any

try:
    import torch
    import transformers
except ImportError as error:
    raise SystemExit(f"export_model: {error}; install: pip install 'transformers<5' torch onnx") from None

from gausslite_detectors.open_vocabulary import INPUTS, OUTPUTS
from gausslite_detectors.text_features import TEXT_ENCODER, TOKENIZER

_OPSET = 17
_PHRASE = "object ."
_PHRASE_TOKENS, _CLIP_TOKENS = 16, 77


class _NamedInputs(torch.nn.Module):
    """Grounding DINO with positional inputs and the two outputs that boxes are read from."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        result = self.model(**dict(zip(INPUTS, inputs, strict=True)))
        return result.logits, result.pred_boxes


class _TextFeatures(torch.nn.Module):
    """CLIP's text encoder with its projected features alone."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, input_ids: torch.Tensor) -> torch.Tensor:
        features: torch.Tensor = self.model(input_ids).text_embeds
        return features


def export_grounding_dino(
    model: Any, path: Path, size_px: tuple[int, int], phrase_ids: list[int], tokens: int = _PHRASE_TOKENS
) -> None:
    """Write a network for images of size_px (width, height) and phrases of up to `tokens` tokens.

    phrase_ids: token ids of any phrase, with which the network is traced.
    """
    width_px, height_px = size_px
    ids = torch.zeros(1, tokens, dtype=torch.int64)
    ids[0, : len(phrase_ids)] = torch.tensor(phrase_ids)
    attention = (torch.arange(tokens) < len(phrase_ids)).long()[None]
    pixel_mask = torch.ones(1, height_px, width_px, dtype=torch.int64)
    example = (torch.zeros(1, 3, height_px, width_px), ids, attention, torch.zeros_like(ids), pixel_mask)
    _export(_NamedInputs(model).eval(), example, path, INPUTS, OUTPUTS, None)


def export_text_encoder(model: Any, path: Path) -> None:
    """Write a text encoder from token ids [n, 77] to text features [n, d]."""
    ids = torch.zeros(1, _CLIP_TOKENS, dtype=torch.int64)
    ids[0, :2] = torch.tensor([model.config.bos_token_id, model.config.eos_token_id])
    sizes = {"input_ids": {0: "n"}, "text_embeds": {0: "n"}}
    _export(_TextFeatures(model).eval(), (ids,), path, ("input_ids",), ("text_embeds",), sizes)


def _export(
    network: torch.nn.Module,
    example: tuple[torch.Tensor, ...],
    path: Path,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    dynamic_sizes: dict[str, dict[int, str]] | None,
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, example, str(path), opset_version=_OPSET, dynamo=False, input_names=list(inputs),
            output_names=list(outputs), dynamic_axes=dynamic_sizes,
        )  # fmt: skip


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("family", choices=["grounding-dino", "text-encoder"])
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="name or folder of a checkpoint for transformers")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the ONNX file and its vocabulary")
    parser.add_argument("--size", metavar="WxH", default="640x480", help="size of Grounding DINO's images")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    options = _parse(arguments)
    try:
        width_px, height_px = (int(side) for side in options.size.split("x"))
        tokenizer = transformers.AutoTokenizer.from_pretrained(options.checkpoint)
        options.folder.mkdir(parents=True, exist_ok=True)
        if options.family == "grounding-dino":
            model = transformers.GroundingDinoForObjectDetection.from_pretrained(options.checkpoint)
            path = options.folder / "grounding-dino.onnx"
            export_grounding_dino(model.eval(), path, (width_px, height_px), tokenizer(_PHRASE).input_ids)
            tokenizer.save_vocabulary(str(options.folder))
        else:
            model = transformers.CLIPTextModelWithProjection.from_pretrained(options.checkpoint)
            path = options.folder / TEXT_ENCODER
            export_text_encoder(model.eval(), path)
            tokenizer.backend_tokenizer.save(str(options.folder / TOKENIZER))
    except (OSError, ValueError) as error:
        print(f"export_model: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
