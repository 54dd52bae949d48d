"""Identify the network of a model file by its inputs and outputs, and build the detector and the segmenter."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Final

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.perception.detect import Detector, SegmentedDetector, Segmenter
from gausslite.perception.models.model_file import OpenModel, open_model
from gausslite.perception.yolo_decode import MASK_COEFFICIENTS

VOCABULARY: Final = "vocab.txt"
OWN_MASKS, DEPTH = "yolo", "depth"


class ModelFamily(StrEnum):
    """Supported networks."""

    GROUNDING_DINO = "Grounding DINO"
    YOLO_SEG = "YOLO-seg or FastSAM"


def identify_family(model: OpenModel) -> ModelFamily:
    """Return the family of an open model. Raises ModelFileError if it is not supported."""
    from gausslite.perception.grounding import is_grounding

    inputs, outputs = model.session.get_inputs(), model.session.get_outputs()
    if is_grounding([each.name for each in inputs], [each.name for each in outputs]):
        return ModelFamily.GROUNDING_DINO
    has_image_input = len(inputs) == 1 and len(inputs[0].shape) == 4
    # a dynamic size is known only after the network has run
    channels = [each.shape[1] for each in outputs if len(each.shape) == 4]
    has_prototypes = any(not isinstance(count, int) or count == MASK_COEFFICIENTS for count in channels)
    if has_image_input and has_prototypes and len(outputs) == 2:
        return ModelFamily.YOLO_SEG
    received = " → ".join(", ".join(f"{each.name} {each.shape}" for each in ports) for ports in (inputs, outputs))
    hint = " (boxes only, no masks)" if has_image_input and len(outputs) == 1 else ""
    raise ModelFileError(f"model {model.path}: expected {' or '.join(ModelFamily)}, got {received}{hint}")


class ModelRegistry:
    """The detector and the segmenter of one mission; each file is opened once."""

    def __init__(
        self, detector: Path, segmenter: str | None, vocabulary: Path | None, threads: int | None,
        accept_similar: bool = False,
    ) -> None:  # fmt: skip
        """Open the detector's file and build the segmenter.

        segmenter: "yolo" (the detector's own masks), "depth" (by depth and colour), or the path of a FastSAM file. None
        selects the detector's own masks if it has them, else "depth". accept_similar: also detect classes that are only
        similar to a noun. Raises ModelFileError, InvalidInputError,
        KernelError.
        """
        model = open_model(detector, threads)
        if identify_family(model) is ModelFamily.GROUNDING_DINO:
            self._use_grounding(model, segmenter, vocabulary, threads)
        else:
            self._use_yolo(model, segmenter, threads, accept_similar)

    @property
    def detector(self) -> Detector:
        """The detector of the task's nouns, with masks."""
        return self._detector

    @property
    def segmenter(self) -> Segmenter:
        """The segmenter of propagated boxes."""
        return self._segmenter

    def _use_grounding(
        self, model: OpenModel, segmenter: str | None, vocabulary: Path | None, threads: int | None
    ) -> None:
        from gausslite.perception.grounding import GroundingDino
        from gausslite.perception.grounding_text import BertTokenizer

        if segmenter == OWN_MASKS:
            raise InvalidInputError(
                f"segmenter: {model.path} finds boxes only; expected depth or a FastSAM file, got {OWN_MASKS}"
            )
        tokenizer = BertTokenizer(vocabulary or model.path.parent / VOCABULARY)
        network = GroundingDino(model, tokenizer)
        self._segmenter: Segmenter = _segmenter(segmenter or DEPTH, threads)
        self._detector: Detector = SegmentedDetector(network, _with_depth_fallback(self._segmenter))

    def _use_yolo(self, model: OpenModel, segmenter: str | None, threads: int | None, accept_similar: bool) -> None:
        from gausslite.perception.yolo import load_yolo

        network = load_yolo(model, accept_similar)
        if segmenter in (None, OWN_MASKS):
            self._segmenter, self._detector = network.segmenter(), network
        else:
            self._segmenter = _segmenter(str(segmenter), threads)
            self._detector = SegmentedDetector(network, _with_depth_fallback(self._segmenter))


def _segmenter(name: str, threads: int | None) -> Segmenter:
    """Return the depth segmenter, or a class-agnostic segmenter from a file."""
    from gausslite.perception.depth_segmenter import DepthSegmenter

    if name == DEPTH:
        return DepthSegmenter()
    from gausslite.perception.class_agnostic import ClassAgnosticSegmenter
    from gausslite.perception.yolo_network import YoloSegNetwork

    return ClassAgnosticSegmenter(YoloSegNetwork(open_model(Path(name), threads)))


def _with_depth_fallback(first: Segmenter) -> tuple[Segmenter, ...]:
    """Return the segmenter, followed by the depth segmenter for boxes in which the network finds nothing."""
    from gausslite.perception.depth_segmenter import DepthSegmenter

    return (first,) if isinstance(first, DepthSegmenter) else (first, DepthSegmenter())
