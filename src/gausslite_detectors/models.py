"""Model files: their catalogue, and the detector that a file becomes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.perception.detector import BoxDetector, Detector, SegmentedDetector, Segmenter, TiledDetector, Tiling
from gausslite_detectors.model_file import OpenModel, open_model, sha256_of
from gausslite_detectors.yolo_network import MASK_COEFFICIENTS


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


def detector_advice() -> str:
    """Return how to make the simplest file for --detector, in one line."""
    entry = entry_named("yolo-seg")
    commands = entry.export.replace("\n", " && ")
    return f"make {entry.file_name} ({entry.licence}) with: {commands}"


VOCABULARY: Final = "vocab.txt"
OWN_MASKS, DEPTH = "yolo", "depth"


class ModelFamily(StrEnum):
    """Supported networks."""

    GROUNDING_DINO = "Grounding DINO"
    YOLO_SEG = "YOLO-seg or FastSAM"
    YOLO_BOXES = "YOLO with class names"
    PROMPTED_YOLO = "YOLO with text features"
    TEXT_ENCODER = "text encoder"


def identify_family(model: OpenModel) -> ModelFamily:
    """Return the family of an open model. Raises ModelFileError if it is not supported."""
    from gausslite_detectors.open_vocabulary import is_grounding, is_prompted
    from gausslite_detectors.text_features import TOKEN_ID_TYPES

    inputs, outputs = model.session.get_inputs(), model.session.get_outputs()
    if is_grounding([port.name for port in inputs], [output.name for output in outputs]):
        return ModelFamily.GROUNDING_DINO
    if is_prompted(model.session):
        return ModelFamily.PROMPTED_YOLO
    if all(len(port.shape) == 2 and port.type in TOKEN_ID_TYPES for port in inputs):
        return ModelFamily.TEXT_ENCODER
    has_image_input = len(inputs) == 1 and len(inputs[0].shape) == 4
    # a dynamic size is known only after the network has run
    channels = [output.shape[1] for output in outputs if len(output.shape) == 4]
    has_prototypes = any(not isinstance(count, int) or count == MASK_COEFFICIENTS for count in channels)
    if has_image_input and has_prototypes and len(outputs) == 2:
        return ModelFamily.YOLO_SEG
    if has_image_input and _has_named_boxes(model):
        return ModelFamily.YOLO_BOXES
    received = " → ".join(", ".join(f"{port.name} {port.shape}" for port in ports) for ports in (inputs, outputs))
    raise ModelFileError(f"model {model.path}: expected one of {', '.join(ModelFamily)}; got {received}")


def _has_named_boxes(model: OpenModel) -> bool:
    """Return True if the only output is [1, 4+c, A] for the c class names in the metadata."""
    from gausslite_detectors.yolo_network import class_names

    (rows, *more), names = [output.shape for output in model.session.get_outputs()], class_names(model.session)
    return not more and bool(names) and len(rows) == 3 and rows[1] in (4 + len(names), None)


class ModelRegistry:
    """The detector of one mission, with its segmenter; each file is opened once."""

    def __init__(
        self, detector: Path, segmenter: str | None, vocabulary: Path | None, threads: int | None,
        accept_similar: bool = False, tiling: Tiling | None = None,
    ) -> None:  # fmt: skip
        """Open the detector's file and build the segmenter.

        segmenter: "yolo" (the detector's own masks), "depth" (by depth and colour), or the path of a FastSAM file. None
        selects the detector's own masks if it has them, else "depth". vocabulary: the text encoder's, by default next
        to the detector. accept_similar: also detect classes that are only similar to a noun. tiling: tiles in which the
        detector also runs; by default none. Raises ModelFileError, InvalidInputError, KernelError.
        """
        model = open_model(detector, threads)
        family = identify_family(model)
        if family is ModelFamily.TEXT_ENCODER:
            raise ModelFileError(f"model {detector}: expected a detector, got a {family}, which belongs beside one")
        self._tiling = tiling or Tiling(1)
        if family is ModelFamily.YOLO_SEG:
            self._use_yolo_masks(model, segmenter, threads, accept_similar)
            return
        if segmenter == OWN_MASKS:
            raise InvalidInputError(
                f"segmenter: {model.path} finds boxes only; expected depth or a FastSAM file, got {OWN_MASKS}"
            )
        segmenters = _with_depth_fallback(_segmenter(segmenter or DEPTH, threads))
        if family is ModelFamily.YOLO_BOXES:
            from gausslite_detectors.yolo import load_yolo

            boxes: BoxDetector = load_yolo(model, accept_similar)
        else:
            boxes = _open_vocabulary(model, family, vocabulary, threads)
        self._detector: Detector = SegmentedDetector(boxes, segmenters)

    @property
    def detector(self) -> Detector:
        """The detector of the task's nouns, with masks."""
        return self._detector if self._tiling.per_side == 1 else TiledDetector(self._detector, self._tiling)

    def _use_yolo_masks(
        self, model: OpenModel, segmenter: str | None, threads: int | None, accept_similar: bool
    ) -> None:
        from gausslite_detectors.yolo import load_yolo

        network = load_yolo(model, accept_similar)
        if segmenter in (None, OWN_MASKS):
            self._detector = network
        else:
            self._detector = SegmentedDetector(network, _with_depth_fallback(_segmenter(str(segmenter), threads)))


def _open_vocabulary(
    model: OpenModel, family: ModelFamily, vocabulary: Path | None, threads: int | None
) -> BoxDetector:
    """Return a detector of any phrase with its text encoder."""
    if family is ModelFamily.GROUNDING_DINO:
        from gausslite_detectors.open_vocabulary import GroundingDino
        from gausslite_detectors.text_features import BertTokenizer

        return GroundingDino(model, BertTokenizer(vocabulary or model.path.parent / VOCABULARY))
    from gausslite_detectors.open_vocabulary import PromptedYolo
    from gausslite_detectors.text_features import open_phrase_vectors

    return PromptedYolo(model, open_phrase_vectors(model.path.parent, vocabulary, threads))


def _segmenter(name: str, threads: int | None) -> Segmenter:
    """Return the depth segmenter, or a class-agnostic segmenter from a file."""
    from gausslite.perception.depth_segmenter import DepthSegmenter

    if name == DEPTH:
        return DepthSegmenter()
    from gausslite_detectors.yolo import ClassAgnosticSegmenter
    from gausslite_detectors.yolo_network import YoloNetwork

    network = YoloNetwork(open_model(Path(name), threads))
    if not network.has_masks:
        raise InvalidInputError(f"segmenter: expected depth or a FastSAM file, got {name}, which finds boxes only")
    return ClassAgnosticSegmenter(network)


def _with_depth_fallback(first: Segmenter) -> tuple[Segmenter, ...]:
    """Return the segmenter, followed by the depth segmenter for boxes in which the network finds nothing."""
    from gausslite.perception.depth_segmenter import DepthSegmenter

    return (first,) if isinstance(first, DepthSegmenter) else (first, DepthSegmenter())


@dataclass(frozen=True, slots=True)
class ModelSheet:
    """Description of a model file that ONNX Runtime can load; inputs and outputs as "name [shape] type"."""

    path: Path
    size_bytes: int
    sha256: str
    family: ModelFamily
    provider: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def inspect(path: Path) -> ModelSheet:
    """Return the description of a model. Raises ModelFileError if it is damaged or of no known family."""
    model = open_model(path, threads=1)
    session = model.session
    described = [
        tuple(f"{port.name} {port.shape} {port.type.removeprefix('tensor').strip('()')}" for port in side)
        for side in (session.get_inputs(), session.get_outputs())
    ]
    family = identify_family(model)
    provider = str(session.get_providers()[0]).removesuffix("ExecutionProvider")
    return ModelSheet(path, path.stat().st_size, sha256_of(path), family, provider, *described)
