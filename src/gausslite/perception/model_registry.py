"""Which kind of network a model file holds, told by its inputs and outputs, and the detector and segmenter it makes."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Final

from gausslite.errors import InvalidInputError, ModelFileError
from gausslite.perception.detect import Detector, SegmentedDetector, Segmenter
from gausslite.perception.model_file import OpenModel, open_model
from gausslite.perception.yolo_decode import MASK_COEFFICIENTS

VOCABULARY: Final = "vocab.txt"
OWN_MASKS, DEPTH = "yolo", "depth"


class ModelFamily(StrEnum):
    """The kinds of networks that are understood."""

    GROUNDING_DINO = "Grounding DINO"
    YOLO_SEG = "YOLO-seg or FastSAM"


def identify_family(model: OpenModel) -> ModelFamily:
    """The family of an open model. Raises ModelFileError for an unknown one."""
    from gausslite.perception.grounding import is_grounding

    inputs, outputs = model.session.get_inputs(), model.session.get_outputs()
    if is_grounding([each.name for each in inputs], [each.name for each in outputs]):
        return ModelFamily.GROUNDING_DINO
    image = len(inputs) == 1 and len(inputs[0].shape) == 4
    # an open size is known once the network has run
    sides = [each.shape[1] for each in outputs if len(each.shape) == 4]
    masks = any(not isinstance(side, int) or side == MASK_COEFFICIENTS for side in sides)
    if image and masks and len(outputs) == 2:
        return ModelFamily.YOLO_SEG
    came = " → ".join(", ".join(f"{each.name} {each.shape}" for each in side) for side in (inputs, outputs))
    hint = " (boxes only, no masks)" if image and len(outputs) == 1 else ""
    raise ModelFileError(f"model {model.path}: expected {' or '.join(ModelFamily)}, got {came}{hint}")


class ModelRegistry:
    """The detector and the segmenters of one mission, each file opened once."""

    def __init__(self, detector: Path, segmenter: str | None, vocabulary: Path | None, threads: int | None) -> None:
        """segmenter: "yolo" (the detector's own masks), "depth" (by depth and colour) or the path of a FastSAM file.

        None takes the detector's own masks where it has some. Raises ModelFileError, InvalidInputError, KernelError.
        """
        model = open_model(detector, threads)
        if identify_family(model) is ModelFamily.GROUNDING_DINO:
            self._use_grounding(model, segmenter, vocabulary, threads)
        else:
            self._use_yolo(model, segmenter, threads)

    @property
    def detector(self) -> Detector:
        """What finds the task's nouns, with masks."""
        return self._detector

    @property
    def segmenter(self) -> Segmenter:
        """What cuts known boxes out of further images."""
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

    def _use_yolo(self, model: OpenModel, segmenter: str | None, threads: int | None) -> None:
        from gausslite.perception.yolo import load_yolo

        network = load_yolo(model)
        if segmenter in (None, OWN_MASKS):
            self._segmenter, self._detector = network.segmenter(), network
        else:
            self._segmenter = _segmenter(str(segmenter), threads)
            self._detector = SegmentedDetector(network, _with_depth_fallback(self._segmenter))


def _segmenter(name: str, threads: int | None) -> Segmenter:
    """The cut, or a file's masks of everything."""
    from gausslite.perception.depth_segmenter import DepthSegmenter

    if name == DEPTH:
        return DepthSegmenter()
    from gausslite.perception.class_agnostic import ClassAgnosticSegmenter
    from gausslite.perception.yolo_network import YoloSegNetwork

    return ClassAgnosticSegmenter(YoloSegNetwork(open_model(Path(name), threads)))


def _with_depth_fallback(first: Segmenter) -> tuple[Segmenter, ...]:
    """A network may see nothing where the detector saw something; then depth and colour still cut it out."""
    from gausslite.perception.depth_segmenter import DepthSegmenter

    return (first,) if isinstance(first, DepthSegmenter) else (first, DepthSegmenter())
