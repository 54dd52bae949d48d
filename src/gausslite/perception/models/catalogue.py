"""Catalogue of the model files that GaussLite can use: purpose, source, licence, and the commands that make each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gausslite.domain.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class ModelEntry:
    """One model file. project: the public project that makes it. export: the commands that make the file."""

    name: str
    file_name: str
    purpose: str
    licence: str
    project: str
    export: str


_ULTRALYTICS: Final = "pip install ultralytics\n"
_TRANSFORMERS: Final = 'pip install "transformers<5" torch onnx\n'

CATALOGUE: Final = (
    ModelEntry(
        "grounding-dino", "grounding-dino.onnx", "--detector: any noun phrase, boxes", "Apache-2.0",
        project="Grounding DINO, IDEA-Research",
        export=_TRANSFORMERS + "tools/export_model.py grounding-dino IDEA-Research/grounding-dino-tiny models",
    ),
    ModelEntry(
        "bert-vocabulary", "vocab.txt", "vocabulary: the vocabulary of grounding-dino", "Apache-2.0",
        project="BERT, Google Research",
        export=_TRANSFORMERS + "tools/export_model.py grounding-dino IDEA-Research/grounding-dino-tiny models",
    ),
    ModelEntry(
        "yolo-seg", "yolo11n-seg.onnx", "--detector: 80 classes with masks", "AGPL-3.0",
        project="YOLO11, Ultralytics",
        export=_ULTRALYTICS + "yolo export model=yolo11n-seg.pt format=onnx",
    ),
    ModelEntry(
        "yoloe", "yoloe-11s-seg.onnx", "--detector: classes of your choice, with masks", "AGPL-3.0",
        project="YOLOE, THU-MIG, in Ultralytics",
        export=_ULTRALYTICS + """python -c "from ultralytics import YOLOE
names = ['mug', 'kettle', 'counter']
model = YOLOE('yoloe-11s-seg.pt')
model.set_classes(names, model.get_text_pe(names))
model.export(format='onnx')\"""",
    ),
    ModelEntry(
        "yolo-world", "yolov8s-worldv2-classes.onnx", "--detector: classes of your choice, boxes",
        "GPL-3.0, AGPL-3.0",
        project="YOLO-World, Tencent AI Lab, in Ultralytics",
        export=_ULTRALYTICS + """python -c "from ultralytics import YOLOWorld
model = YOLOWorld('yolov8s-worldv2.pt')
model.set_classes(['mug', 'kettle', 'counter'])
model.save('yolov8s-worldv2-classes.pt')"
yolo export model=yolov8s-worldv2-classes.pt format=onnx""",
    ),
    ModelEntry(
        "yolo-world-text", "yolo-world-text.onnx", "--detector: any noun, boxes; needs text-encoder or noun-vectors",
        "GPL-3.0",
        project="YOLO-World, Tencent AI Lab, with the export of the project yolo-world-onnx",
        export="# in a copy of yolo-world-onnx; the file's name differs\nmake install\n./export_onnx.py",
    ),
    ModelEntry(
        "text-encoder", "text_encoder.onnx", "text features of any phrase, beside yolo-world-text", "MIT",
        project="CLIP ViT-B/32, OpenAI",
        export=_TRANSFORMERS + "tools/export_model.py text-encoder openai/clip-vit-base-patch32 models",
    ),
    ModelEntry(
        "text-tokenizer", "tokenizer.json", "the vocabulary of text-encoder", "MIT",
        project="CLIP ViT-B/32, OpenAI",
        export=_TRANSFORMERS + "tools/export_model.py text-encoder openai/clip-vit-base-patch32 models",
    ),
    ModelEntry(
        "noun-vectors", "lvis_v1_clip_a+cname.npy", "text features of 1203 nouns, beside any YOLO", "Apache-2.0",
        project="Detic, Meta: folder datasets/metadata",
        export="copy lvis_v1_clip_a+cname.npy and lvis_v1_train_cat_info.json from that folder",
    ),
    ModelEntry(
        "noun-names", "lvis_v1_train_cat_info.json", "the nouns of noun-vectors", "Apache-2.0",
        project="Detic, Meta: folder datasets/metadata",
        export="copy lvis_v1_clip_a+cname.npy and lvis_v1_train_cat_info.json from that folder",
    ),
    ModelEntry(
        "fastsam", "FastSAM-s.onnx", "segmenter: masks of everything", "AGPL-3.0",
        project="FastSAM, CASIA, in Ultralytics",
        export=_ULTRALYTICS + "yolo export model=FastSAM-s.pt format=onnx",
    ),
)  # fmt: skip


def entry_named(name: str) -> ModelEntry:
    """Return the entry with this name. Raises InvalidInputError with the known names."""
    for entry in CATALOGUE:
        if entry.name == name:
            return entry
    raise InvalidInputError(f"model {name!r}: expected one of {', '.join(entry.name for entry in CATALOGUE)}")
