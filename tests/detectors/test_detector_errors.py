"""Settings of detectors and segmenters that are refused by name."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from gausslite.domain.errors import InvalidInputError
from gausslite_detectors.boxes import BoxSizeLimits
from gausslite_detectors.class_detector import ClassAgnosticSettings, ClassDetectorSettings
from gausslite_detectors.depth_segmenter import DepthSegmenterSettings
from gausslite_detectors.model_file import open_model
from gausslite_detectors.open_vocabulary import GroundingSettings
from gausslite_detectors.tiles import Tiling


@pytest.mark.parametrize(
    ("call", "wrong", "message"),
    [
        (ClassDetectorSettings, {"min_score": 1.5}, "detector min_score: expected between 0 and 1"),
        (BoxSizeLimits, {"scale": 0.0}, "box limit scale: expected a positive number"),
        (BoxSizeLimits, {"min_known_share": 1.5}, "box limit min_known_share: expected 0 to 1"),
        *((ClassAgnosticSettings, {name: 1.0}, name) for name in ("min_score", "nms_max_iou", "min_box_iou")),
        (ClassAgnosticSettings, {"max_masks": 0}, "max_masks"),
        *((DepthSegmenterSettings, {name: math.nan}, name) for name in ("depth_step", "colour_step")),
        (DepthSegmenterSettings, {"side_px": 1}, "side_px"),
        *((GroundingSettings, {name: 0.0}, name) for name in ("box_score", "text_score", "nms_max_iou")),
        (GroundingSettings, {"max_boxes": 0}, "max_boxes"),
        *((Tiling, {"per_side": count}, "tiles: expected 1 to 4 per side") for count in (0, 5)),
        (open_model, {"path": Path("any.onnx"), "threads": 0}, "threads"),
    ],
)
def test_a_wrong_setting_is_named(call: Callable[..., object], wrong: dict[str, object], message: str) -> None:
    pytest.raises(InvalidInputError, call, **wrong).match(message)
