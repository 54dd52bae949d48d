"""Class-agnostic masks matched to boxes, on a network with known results, and the thresholds."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_yolo import write_tiny_yolo

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.perception.class_agnostic import ClassAgnosticSegmenter, ClassAgnosticSettings
from gausslite.perception.models.model_file import open_model
from gausslite.perception.yolo_network import YoloNetwork

SURE = (24.0, 32.0, 16.0, 16.0, 0, 0.9)
# the same square in the image's pixels, which are half the network's, moved down by 16 rows of padding
BOX = (32.0, 16.0, 64.0, 48.0)


def frame_with_red_square() -> Frame:
    rgb = np.zeros((64, 128, 3), np.uint8)
    rgb[16:48, 32:64, 0] = 255
    return Frame(0, 0, rgb, np.ones((64, 128), np.float32), Camera(100, 100, 64, 32, 128, 64), np.eye(4))


def segmenter(tmp_path, *boxes, names=("object",)):
    return ClassAgnosticSegmenter(
        YoloNetwork(open_model(write_tiny_yolo(tmp_path / "tiny.onnx", names, boxes, named=False)))
    )


def masks(tmp_path, *boxes, given=(BOX,), names=("object",)):
    return segmenter(tmp_path, *boxes, names=names).segment(frame_with_red_square(), np.asarray(given, np.float32))


def test_a_file_without_metadata_segments_the_object_in_the_box(tmp_path):
    (mask,) = masks(tmp_path, SURE)
    assert mask is not None
    assert mask[16:48, 32:64].mean() > 0.97
    assert mask.sum() == mask[16:48, 32:64].sum()


def test_each_box_gets_the_mask_with_the_largest_overlap(tmp_path):
    larger = (26.0, 32.0, 20.0, 16.0, 0, 0.95)
    whole, half = masks(tmp_path, SURE, larger, given=(BOX, (32, 16, 80, 48)))
    assert whole is not None
    assert half is not None
    assert whole[16:48, 32:64].mean() > 0.97
    assert half.sum() >= whole.sum()


def test_boxes_without_a_confident_matching_instance_get_no_mask(tmp_path):
    beside = (48.0, 16.0, 80.0, 48.0)
    assert masks(tmp_path, SURE, given=(beside,)) == [None]
    assert masks(tmp_path, (*SURE[:5], 0.39)) == [None]
    assert masks(tmp_path) == [None]


def test_no_boxes_give_no_masks(tmp_path):
    assert segmenter(tmp_path, SURE).segment(frame_with_red_square(), np.zeros((0, 4), np.float32)) == []


def test_a_network_of_many_classes_has_a_lower_threshold(tmp_path):
    (mask,) = masks(tmp_path, (*SURE[:5], 0.04), names=("cup", "chair"))
    assert mask is not None


def test_settings_are_checked():
    for name in ("min_score", "nms_max_iou", "min_box_iou"):
        with pytest.raises(InvalidInputError, match=name):
            ClassAgnosticSettings(**{name: 1.0})
    with pytest.raises(InvalidInputError, match="max_masks"):
        ClassAgnosticSettings(max_masks=0)
