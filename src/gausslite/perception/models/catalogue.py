"""Catalogue of the model files that GaussLite can use: purpose, source, licence, maximum size and optional SHA-256."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gausslite.domain.errors import InvalidInputError

_MIB: Final = 1 << 20
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class ModelEntry:
    """One model file. path: its location below the address of --base-url; the last part is its name on disk.

    project: the public project that makes it. export: the commands that make the file, one per line. Raises
    InvalidInputError for invalid fields.
    """

    name: str
    path: str
    purpose: str
    licence: str
    max_mib: int
    sha256: str | None = None
    project: str = ""
    export: str = ""

    def __post_init__(self) -> None:
        parts = self.path.split("/")
        if not _NAME.fullmatch(self.name) or not all(_NAME.fullmatch(part) for part in parts):
            raise InvalidInputError(
                f"catalogue {self.name!r}: expected a name and a path of letters, digits and ._+-, got {self.path!r}"
            )
        if not 1 <= self.max_mib <= 1 << 20:
            raise InvalidInputError(f"catalogue {self.name}: expected max_mib from 1 to 1048576, got {self.max_mib}")
        if self.sha256 is not None and not _DIGEST.fullmatch(self.sha256):
            raise InvalidInputError(f"catalogue {self.name}: expected a SHA-256 of 64 hex digits, got {self.sha256!r}")

    @property
    def file_name(self) -> str:
        """Name of the file on disk."""
        return self.path.rsplit("/", 1)[-1]

    @property
    def max_bytes(self) -> int:
        """Maximum size of the file in bytes."""
        return self.max_mib * _MIB


_ULTRALYTICS: Final = "pip install ultralytics\n"
_TRANSFORMERS: Final = 'pip install "transformers<5" torch onnx\n'

CATALOGUE: Final = (
    ModelEntry(
        "grounding-dino", "grounding-dino.onnx", "--detector: any noun phrase, boxes", "Apache-2.0", 1024,
        project="Grounding DINO, IDEA-Research",
        export=_TRANSFORMERS + "tools/export_model.py grounding-dino IDEA-Research/grounding-dino-tiny models",
    ),
    ModelEntry(
        "bert-vocabulary", "vocab.txt", "--vocabulary: the vocabulary of grounding-dino", "Apache-2.0", 1,
        project="BERT, Google Research",
        export=_TRANSFORMERS + "tools/export_model.py grounding-dino IDEA-Research/grounding-dino-tiny models",
    ),
    ModelEntry(
        "yolo-seg", "yolo11n-seg.onnx", "--detector: 80 classes with masks", "AGPL-3.0", 256,
        project="YOLO11, Ultralytics",
        export=_ULTRALYTICS + "yolo export model=yolo11n-seg.pt format=onnx",
    ),
    ModelEntry(
        "yoloe", "yoloe-11s-seg.onnx", "--detector: classes of your choice, with masks", "AGPL-3.0", 512,
        project="YOLOE, THU-MIG, in Ultralytics",
        export=_ULTRALYTICS + """python -c "from ultralytics import YOLOE
names = ['mug', 'kettle', 'counter']
model = YOLOE('yoloe-11s-seg.pt')
model.set_classes(names, model.get_text_pe(names))
model.export(format='onnx')\"""",
    ),
    ModelEntry(
        "yolo-world", "yolov8s-worldv2-classes.onnx", "--detector: classes of your choice, boxes",
        "GPL-3.0, AGPL-3.0", 512,
        project="YOLO-World, Tencent AI Lab, in Ultralytics",
        export=_ULTRALYTICS + """python -c "from ultralytics import YOLOWorld
model = YOLOWorld('yolov8s-worldv2.pt')
model.set_classes(['mug', 'kettle', 'counter'])
model.save('yolov8s-worldv2-classes.pt')"
yolo export model=yolov8s-worldv2-classes.pt format=onnx""",
    ),
    ModelEntry(
        "yolo-world-text", "yolo-world-text.onnx", "--detector: any noun, boxes; needs text-encoder or noun-vectors",
        "GPL-3.0", 1024,
        project="YOLO-World, Tencent AI Lab, with the export of the project yolo-world-onnx",
        export="# in a copy of yolo-world-onnx; the file's name differs\nmake install\n./export_onnx.py",
    ),
    ModelEntry(
        "text-encoder", "text_encoder.onnx", "text features of any phrase, beside yolo-world-text", "MIT", 512,
        project="CLIP ViT-B/32, OpenAI",
        export=_TRANSFORMERS + "tools/export_model.py text-encoder openai/clip-vit-base-patch32 models",
    ),
    ModelEntry(
        "text-tokenizer", "tokenizer.json", "the vocabulary of text-encoder", "MIT", 16,
        project="CLIP ViT-B/32, OpenAI",
        export=_TRANSFORMERS + "tools/export_model.py text-encoder openai/clip-vit-base-patch32 models",
    ),
    ModelEntry(
        "noun-vectors", "lvis_v1_clip_a+cname.npy", "text features of 1203 nouns, beside any YOLO", "Apache-2.0", 16,
        project="Detic, Meta: folder datasets/metadata",
        export="copy lvis_v1_clip_a+cname.npy and lvis_v1_train_cat_info.json from that folder",
    ),
    ModelEntry(
        "noun-names", "lvis_v1_train_cat_info.json", "the nouns of noun-vectors", "Apache-2.0", 16,
        project="Detic, Meta: folder datasets/metadata",
        export="copy lvis_v1_clip_a+cname.npy and lvis_v1_train_cat_info.json from that folder",
    ),
    ModelEntry(
        "fastsam", "FastSAM-s.onnx", "--segmenter: masks of everything", "AGPL-3.0", 512,
        project="FastSAM, CASIA, in Ultralytics",
        export=_ULTRALYTICS + "yolo export model=FastSAM-s.pt format=onnx",
    ),
)  # fmt: skip
"""No entry has a SHA-256, because exports of one network differ. Pin that of your file by --sha256 or a catalogue."""


def read_catalogue(path: Path) -> tuple[ModelEntry, ...]:
    """Return the entries of a TOML file: one table per model, with the fields of ModelEntry.

    Raises InvalidInputError.
    """
    try:
        tables: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"catalogue {path}: expected readable TOML, but {error}") from error
    return tuple(_entry(path, name, table) for name, table in tables.items())


def entry_named(entries: tuple[ModelEntry, ...], name: str) -> ModelEntry:
    """Return the entry with this name. Raises InvalidInputError with the known names."""
    for entry in entries:
        if entry.name == name:
            return entry
    known = ", ".join(entry.name for entry in entries) or "none"
    raise InvalidInputError(f"model {name!r}: expected one of {known}")


def _entry(path: Path, name: str, table: Any) -> ModelEntry:
    kinds = {"path": str, "purpose": str, "licence": str, "max_mib": int, "sha256": str, "project": str, "export": str}
    required = set(kinds) - {"sha256", "project", "export"}
    fits = (
        isinstance(table, dict)
        and required <= set(table) <= set(kinds)
        and all(type(value) is kinds[key] for key, value in table.items())
    )
    if not fits:
        raise InvalidInputError(
            f"catalogue {path}: {name}: expected texts path, purpose, licence, a whole max_mib and perhaps sha256, "
            "project, export"
        )
    return ModelEntry(name, **table)
