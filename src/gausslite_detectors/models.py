"""Model files: their catalogue, and the detector that a file becomes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.perception.detector import Detector
from gausslite.perception.detector_file import DetectorOptions
from gausslite_detectors.boxes import BoxDetector, SegmentedDetector, Segmenter
from gausslite_detectors.depth_segmenter import DepthSegmenter
from gausslite_detectors.layouts import ModelFamily
from gausslite_detectors.model_file import OpenModel, open_model, sha256_of
from gausslite_detectors.network import DetectionNetwork
from gausslite_detectors.tiles import TiledDetector, Tiling


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
        "rf-detr-seg", "rfdetr-seg-nano.onnx", "--detector: 80 classes with masks", "Apache-2.0",
        project="RF-DETR, Roboflow",
        export="""pip install "rfdetr[onnx]"
python -c "from rfdetr import RFDETRSegNano; RFDETRSegNano().export(output_dir='.')\"""",
    ),
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


VOCABULARY: Final = "vocab.txt"
OWN_MASKS, DEPTH = "yolo", "depth"


def _family_of_text(model: OpenModel) -> ModelFamily | None:
    """Return the family of a model with texts as an input; None for others, whose outputs decide."""
    from gausslite_detectors.open_vocabulary import is_grounding, is_prompted
    from gausslite_detectors.text_features import TOKEN_ID_TYPES

    inputs, outputs = model.session.get_inputs(), model.session.get_outputs()
    if is_grounding([port.name for port in inputs], [output.name for output in outputs]):
        return ModelFamily.GROUNDING_DINO
    if is_prompted(model.session):
        return ModelFamily.PROMPTED_YOLO
    if all(len(port.shape) == 2 and port.type in TOKEN_ID_TYPES for port in inputs):
        return ModelFamily.TEXT_ENCODER
    return None


class OnnxReader:
    """The DetectorReader of ONNX files; each file is opened once."""

    def open(self, path: Path, options: DetectorOptions) -> Detector:
        """Return the file's detector, also in tiles. Raises ModelFileError, InvalidInputError, KernelError."""
        from gausslite_detectors.class_detector import ClassDetectorSettings

        tiling = Tiling(options.tiles_per_side, options.time_limit_s)
        if options.min_score is not None:
            least = options.min_score / ClassDetectorSettings().min_score * tiling.min_new_score
            tiling = replace(tiling, min_new_score=min(least, tiling.min_new_score))
        detector = self._open(path, options)
        return detector if tiling.per_side == 1 else TiledDetector(detector, tiling)

    def _open(self, path: Path, options: DetectorOptions) -> Detector:
        """Return the file's detector with its segmenter.

        segmenter: "yolo", "depth", or the path of a FastSAM file. None selects the detector's own masks if it has them,
        else "depth". vocabulary: the text encoder's, by default next to the detector.
        """
        from gausslite_detectors.class_detector import load_class_detector

        model = open_model(path, options.threads)
        family = _family_of_text(model)
        if family is ModelFamily.TEXT_ENCODER:
            raise ModelFileError(f"model {path}: expected a detector, got a {family}, which belongs beside one")
        classes = load_class_detector(model, options.accept_similar, options.min_score) if family is None else None
        if classes is not None and classes.has_masks and options.segmenter in (None, OWN_MASKS):
            return classes
        if options.segmenter == OWN_MASKS:
            raise InvalidInputError(
                f"segmenter: {model.path} finds boxes only; expected depth or a FastSAM file, got {OWN_MASKS}"
            )
        segmenters = _segmenters(options.segmenter or DEPTH, options.threads)
        return SegmentedDetector(classes or _open_vocabulary(model, family, options), segmenters)

    def advice(self) -> str:
        """Return how to make the simplest file, in one line."""
        entry = entry_named("rf-detr-seg")
        commands = entry.export.replace("\n", " && ")
        return f"make {entry.file_name} ({entry.licence}) with: {commands}"


READER: Final = OnnxReader()


def _open_vocabulary(model: OpenModel, family: ModelFamily | None, options: DetectorOptions) -> BoxDetector:
    """Return a detector of any phrase with its text encoder."""
    from gausslite_detectors.open_vocabulary import GroundingDino, GroundingSettings, PromptedYolo, PromptedYoloSettings
    from gausslite_detectors.text_features import BertTokenizer, open_phrase_vectors

    folder = model.path.parent
    least = options.min_score
    if family is ModelFamily.GROUNDING_DINO:
        tokenizer = BertTokenizer(options.vocabulary or folder / VOCABULARY)
        settings = GroundingSettings() if least is None else GroundingSettings(0.8 * least, least)
        return GroundingDino(model, tokenizer, settings)
    vectors = open_phrase_vectors(folder, options.vocabulary, options.threads)
    return PromptedYolo(model, vectors, PromptedYoloSettings() if least is None else PromptedYoloSettings(least))


def _segmenters(name: str, threads: int | None) -> tuple[Segmenter, ...]:
    """Return the depth segmenter, after that of a file for boxes in which its network finds nothing."""
    if name == DEPTH:
        return (DepthSegmenter(),)
    from gausslite_detectors.class_detector import ClassAgnosticSegmenter

    network = DetectionNetwork(open_model(Path(name), threads))
    if not network.layout.has_masks:
        raise InvalidInputError(f"segmenter: expected depth or a FastSAM file, got {name}, which finds boxes only")
    return ClassAgnosticSegmenter(network), DepthSegmenter()


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
    classes: tuple[str, ...]  # "" for an index without a name; empty for texts as queries


def inspect(path: Path) -> ModelSheet:
    """Return the description of a model. Raises ModelFileError if it is damaged or of no known family."""
    model = open_model(path, threads=1)
    described = [
        tuple(f"{port.name} {port.shape} {port.type.removeprefix('tensor').strip('()')}" for port in side)
        for side in (model.session.get_inputs(), model.session.get_outputs())
    ]
    family, classes = _family_of_text(model), tuple[str, ...]()
    if family is None:
        layout = DetectionNetwork(model).layout
        family, classes = layout.family, layout.names
    provider = str(model.session.get_providers()[0]).removesuffix("ExecutionProvider")
    return ModelSheet(path, path.stat().st_size, sha256_of(path), family, provider, *[*described, classes])
