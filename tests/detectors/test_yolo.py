"""YOLO networks end to end with known results: classes with masks, class-agnostic masks, and invalid files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_yolo import write_boxes_only, write_tiny_yolo

from gausslite.domain.camera import Camera
from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import POINTING, found_text
from gausslite.domain.relevance import Detection
from gausslite.domain.task import TaskGraph
from gausslite.perception.detector_file import DetectorOptions
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.settings import EvidenceSettings, RelevanceTrackerSettings
from gausslite_detectors.boxes import BoxSizeLimits
from gausslite_detectors.class_detector import (
    ClassAgnosticSegmenter,
    ClassDetector,
    ClassDetectorSettings,
    load_class_detector,
)
from gausslite_detectors.model_file import open_model
from gausslite_detectors.models import READER
from gausslite_detectors.network import DetectionNetwork
from gausslite_detectors.tiles import TiledDetector, Tiling

NAMES = ("cup", "chair", "dining table")


def detector_from(path: Path) -> ClassDetector:
    return load_class_detector(open_model(path, threads=1))


def frame_with_red_square() -> Frame:
    """128x64: scaled by one half into 64x64, padded by 16 rows above and below."""
    rgb = np.zeros((64, 128, 3), np.uint8)
    rgb[16:48, 32:64, 0] = 255
    return Frame(0, 0, rgb, np.ones((64, 128), np.float32), Camera(100, 100, 64, 32, 128, 64), np.eye(4))


# the square in the network's pixels: columns 16 to 32, rows 24 to 40
CUP = (24.0, 32.0, 16.0, 16.0, 0, 0.9)


def mapped(detections: Sequence[Detection]) -> list[Detection]:
    """Return the detections with a mask; the others are only reported."""
    return [detection for detection in detections if detection.mask.any()]


def test_boxes_and_masks_are_mapped_back_to_the_image(tmp_path):
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [CUP]))
    (found,) = detector.detect(frame_with_red_square(), ["mug"])
    assert found.phrase == "mug"
    assert found.score == pytest.approx(0.9)
    assert found.box_px == pytest.approx((32, 16, 64, 48))
    expected = np.zeros((64, 128), np.bool_)
    expected[16:48, 32:64] = True
    overlap = (found.mask & expected).sum() / (found.mask | expected).sum()
    # interpolation rounds the four corners and nothing else; any shift by half a pixel would break the symmetry
    assert overlap > 0.97
    assert not (found.mask & ~expected).any()
    inside = found.mask[16:48, 32:64]
    assert np.array_equal(inside, inside[::-1])
    assert np.array_equal(inside, inside[:, ::-1])


def test_a_frame_that_was_made_smaller_is_searched_as_recorded(tmp_path):
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [CUP]))
    recorded = frame_with_red_square()
    camera = recorded.camera.resized(64, 32)
    # what is seen in the recorded image only
    small = replace(
        recorded,
        rgb=np.zeros((32, 64, 3), np.uint8),
        depth_m=np.ones((32, 64), np.float32),
        camera=camera,
        recorded_rgb=recorded.rgb,
    )
    (found,) = detector.detect(small, ["mug"])
    assert found.box_px == pytest.approx((16, 8, 32, 24))
    expected = np.zeros((32, 64), np.bool_)
    expected[8:24, 16:32] = True
    assert (found.mask & expected).sum() / (found.mask | expected).sum() > 0.9
    assert mapped(detector.detect(replace(small, recorded_rgb=None), ["mug"])) == []


def test_a_mask_stays_in_its_box(tmp_path):
    narrow = (24.0, 32.0, 8.0, 16.0, 0, 0.9)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [narrow]))
    (found,) = detector.detect(frame_with_red_square(), ["cup"])
    assert not found.mask[:, :40].any()
    assert not found.mask[:, 56:].any()
    assert found.mask[16:48, 40:56].all()


def test_suppression_is_per_class(tmp_path):
    shifted, chair = (25.0, 32.0, 16.0, 16.0, 0, 0.8), (24.0, 32.0, 16.0, 16.0, 1, 0.7)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [shifted, CUP, chair]))
    found = detector.detect(frame_with_red_square(), ["cup", "chair"])
    assert [(each.phrase, round(each.score, 2)) for each in found] == [("cup", 0.9), ("chair", 0.7)]


def test_boxes_below_the_score_or_without_a_mask_are_dropped(tmp_path):
    doubtful, black = (24.0, 32.0, 16.0, 16.0, 0, 0.08), (52.0, 32.0, 16.0, 16.0, 0, 0.9)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [doubtful, black]))
    (unmapped,) = detector.detect(frame_with_red_square(), ["cup"])
    assert (unmapped.mask.any(), unmapped.is_weak, unmapped.score) == (False, True, pytest.approx(0.9))


def test_boxes_below_the_threshold_are_weak_and_of_named_objects_only(tmp_path):
    weak, sure = (24.0, 32.0, 8.0, 8.0, 0, 0.2), (22.0, 32.0, 12.0, 16.0, 1, 0.3)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [weak, sure]))
    found = detector.detect(frame_with_red_square(), ["cup", "chair"])
    assert [(each.phrase, each.is_weak) for each in found] == [("cup", True), ("chair", False)]
    assert [each.is_weak for each in detector.detect(frame_with_red_square(), ["object"])] == [False]


def test_boxes_too_large_for_their_class_are_dropped_whatever_else_is_asked_for(tmp_path):
    huge = (32.0, 32.0, 64.0, 24.0, 0, 0.9)
    path = write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [huge])
    near = frame_with_red_square()
    near = replace(near, depth_m=0.3 * near.depth_m)
    far = replace(near, depth_m=2.0 * near.depth_m)
    # the box is 0.38 m wide at a depth of 0.3 m, and 0.77 m wide at 0.6 m
    for queries in (["cup"], ["cup", "chair", "table"]):
        assert len(detector_from(path).detect(near, queries)) == 1
        assert mapped(detector_from(path).detect(far, queries)) == []
    lenient = ClassDetector(open_model(path), None, ClassDetectorSettings(box_limits=BoxSizeLimits(scale=2.0)))
    assert len(lenient.detect(far, ["cup"])) == 1


def test_a_generic_noun_matches_every_class(tmp_path):
    chair = (20.0, 30.0, 10.0, 10.0, 1, 0.7)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [CUP, chair]))
    assert len(detector.detect(frame_with_red_square(), ["obstacle"])) == 2


def test_everything_else_is_detected_by_its_class_beside_the_named_things_as_they_are(tmp_path):
    boxes = [CUP, (20.0, 30.0, 10.0, 10.0, 1, 0.7), (28.0, 36.0, 8.0, 8.0, 0, 0.15)]
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, boxes))
    frame = frame_with_red_square()
    named = detector.detect(frame, ["cup"])
    both = detector.detect(frame, ["cup", "object"])
    assert [(each.score, each.box_px) for each in both if each.phrase == "cup"] == [
        (each.score, each.box_px) for each in named
    ]
    assert {each.class_name for each in both if each.phrase == "object"} == {"cup", "chair"}


def test_a_noun_without_a_class_is_unsupported(tmp_path):
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [CUP]))
    assert detector.detect(frame_with_red_square(), ["umbrella"]) == []
    cup, umbrella = detector.matches(["cup", "umbrella"])
    assert (cup.classes, cup.is_searched, cup.warning) == (("cup",), True, None)
    expected = f"no class of the detector matches 'umbrella'; {POINTING}, or prompt a detector by text"
    assert (umbrella.is_searched, umbrella.warning) == (False, expected)


def test_a_different_class_in_the_same_box_is_the_rival(tmp_path):
    tv, laptop = (24.0, 32.0, 16.0, 16.0, 0, 0.8), (25.0, 32.0, 16.0, 16.0, 1, 0.4)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", ("tv", "laptop"), [tv, laptop]))
    (found,) = detector.detect(frame_with_red_square(), ["laptop"])
    assert found.rival is not None
    assert (found.rival.name, found.rival.score) == ("tv", pytest.approx(0.8))
    (object_1, object_2) = detector.detect(frame_with_red_square(), ["object"])
    assert (object_1.rival, object_2.rival) == (None, None)


def test_what_is_rather_another_class_is_reported_and_not_activated(tmp_path):
    tv, laptop = (24.0, 32.0, 16.0, 16.0, 0, 0.8), (25.0, 32.0, 16.0, 16.0, 1, 0.4)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", ("tv", "laptop"), [tv, laptop]))
    task = TaskGraph("id", "find the laptop", ("laptop",), (), ())
    strict = TaskRelevanceEstimator(task, detector)
    lenient = TaskRelevanceEstimator(
        task, detector, RelevanceTrackerSettings(evidence=EvidenceSettings.accept_similar())
    )
    frames = [replace(frame_with_red_square(), index=index, capture_time_ns=index * 10**9) for index in range(7)]
    assert not any(strict.estimate(frame).relevance.roi.any() for frame in frames)
    assert any(lenient.estimate(frame).relevance.roi.any() for frame in frames)
    assert strict.notes == ("what looks like 'laptop' is rather 'tv': not activated; --accept-similar accepts it",)
    (report,) = strict.nouns
    assert (report.rival, report.objects, report.best_score) == ("tv", 0, pytest.approx(0.4))
    assert report.describe().endswith("best score 0.40, none confirmed, rather 'tv'")
    once = TaskRelevanceEstimator(
        task, detector_from(write_tiny_yolo(tmp_path / "once.onnx", ("tv", "laptop"), [laptop]))
    )
    once.estimate(frames[0])
    assert once.objects == ()
    assert once.nouns[0].describe().endswith("none confirmed, which takes two moments or places")
    missing = found_text((), ("laptop",), np.zeros((0, 3), np.float32), once.nouns)
    assert missing == "no laptop (1 detections, best score 0.40, none confirmed, which takes two moments or places)"
    restored = TaskRelevanceEstimator(task, detector)
    restored.restore(strict.state())
    assert restored.nouns == strict.nouns


@pytest.mark.parametrize(
    ("score", "expected"),
    [
        (0.1, f"seen in frame 3 with 0.10 (threshold 0.25): --set min-score=0.08, or {POINTING}"),
        (
            0.01,
            "not seen so far; if a frame shows it, point at it (--set view=8099, or target-at=X,Y,Z,R without --task)",
        ),
        (
            0.9,
            "seen in frame 3 with 0.90, but too large, without depth, or enlarged only: a lower min-score may do, "
            f"or {POINTING}",
        ),
    ],
)
def test_a_noun_that_is_not_found_says_what_was_seen(tmp_path, score, expected):
    box = (32.0, 32.0, 64.0, 24.0, 1, score) if score > 0.5 else (24.0, 32.0, 16.0, 16.0, 1, score)
    for index, path in enumerate((tmp_path / "masks.onnx", tmp_path / "boxes.onnx")):
        (write_boxes_only if index else write_tiny_yolo)(path, ("tv", "book"), [box])
        detector = TiledDetector(READER.open(path, DetectorOptions(threads=1)), Tiling(2))
        estimator = TaskRelevanceEstimator(TaskGraph("id", "find the book", ("book",), (), ()), detector)
        assert not estimator.estimate(replace(frame_with_red_square(), index=3)).relevance.roi.any()
        (report,) = estimator.nouns
        assert report.describe().endswith(expected)
        assert (report.detections, report.objects) == (0, 0)
        restored = TaskRelevanceEstimator(TaskGraph("id", "find the book", ("book",), (), ()), detector)
        restored.restore(estimator.state())
        assert restored.nouns == estimator.nouns


def test_one_threshold_holds_for_detections_and_weak_ones(tmp_path):
    path = write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [(24.0, 32.0, 16.0, 16.0, 1, 0.09)])
    for least, is_weak in ((0.08, False), (0.2, True)):
        detector = READER.open(path, DetectorOptions(threads=1, min_score=least))
        (found,) = detector.detect(frame_with_red_square(), ["chair"])
        assert (found.is_weak, found.mask.any()) == (is_weak, True)
        assert [match.min_score for match in detector.matches(["chair"])] == [least]


@pytest.mark.parametrize(("score", "marked"), [(0.3, {True, False}), (0.5, {True})])
def test_an_object_with_a_far_lower_score_than_another_is_left_out(tmp_path, score, marked):
    high, low = (24.0, 32.0, 16.0, 16.0, 0, 0.9), (48.0, 32.0, 16.0, 16.0, 0, score)
    detector = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", ("bottle",), [high, low]))
    task = TaskGraph("id", "find the bottles", ("bottle",), (), ())
    strict = TaskRelevanceEstimator(task, detector, RelevanceTrackerSettings(max_frames=1))
    settings = RelevanceTrackerSettings(max_frames=1, evidence=EvidenceSettings.accept_similar())
    lenient = TaskRelevanceEstimator(task, detector, settings)
    frame = frame_with_red_square()
    frame.rgb[16:48, 80:112, 0] = 255
    for index in range(2):
        later = replace(frame, index=index, capture_time_ns=index * 10**9)
        strict_roi, lenient_roi = (each.estimate(later).relevance.roi for each in (strict, lenient))
    left, right = slice(0, strict_roi.shape[1] // 2), slice(strict_roi.shape[1] // 2, None)
    assert {bool(strict_roi[:, half].any()) for half in (left, right)} == marked
    assert all(lenient_roi[:, half].any() for half in (left, right))
    left_out = ("'bottle': 1 scored far below the best, so not activated; --accept-similar accepts all",)
    assert strict.notes == (left_out if False in marked else ())
    assert (len(strict.objects), len(lenient.objects)) == (1 if False in marked else 2, 2)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "found nothing"),
        (b"", "expected a readable ONNX model"),
        (b"not a model", "expected a readable ONNX model"),
    ],
)
def test_a_missing_or_damaged_file_is_refused_in_one_line(tmp_path, content, expected):
    path = tmp_path / "model.onnx"
    if content is not None:
        path.write_bytes(content)
    _refused(path, expected)


def test_a_truncated_file_is_refused(tmp_path):
    path = write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [CUP])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    _refused(path, "expected a readable ONNX model")


def test_boxes_without_masks_are_those_of_the_network_with_masks(tmp_path):
    chair = (40.0, 30.0, 10.0, 12.0, 1, 0.7)
    boxes_only = detector_from(write_boxes_only(tmp_path / "boxes.onnx", NAMES, [CUP, chair]))
    with_masks = detector_from(write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [CUP, chair]))
    assert (boxes_only.has_masks, with_masks.has_masks) == (False, True)
    frame = frame_with_red_square()
    assert boxes_only.boxes(frame, ["mug", "chair"]) == with_masks.boxes(frame, ["mug", "chair"])


def test_a_model_with_other_rows_than_its_class_names_is_refused(tmp_path):
    _refused(
        write_boxes_only(tmp_path / "boxes.onnx", NAMES, [CUP], more_rows=1),
        r"got boxes with objectness, .*\[1, 8, 1\]",
    )


def test_a_model_without_class_names_is_refused(tmp_path):
    _refused(
        write_tiny_yolo(tmp_path / "tiny.onnx", NAMES, [], named=False), "class names in the metadata field 'names'"
    )


def _refused(path: Path, expected: str) -> None:
    with pytest.raises(ModelFileError, match=expected) as caught:
        detector_from(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


SURE = (24.0, 32.0, 16.0, 16.0, 0, 0.9)
# the same square in the image's pixels, which are half the network's, moved down by 16 rows of padding
BOX = (32.0, 16.0, 64.0, 48.0)


def segmenter(tmp_path, *boxes, names=("object",)):
    return ClassAgnosticSegmenter(
        DetectionNetwork(open_model(write_tiny_yolo(tmp_path / "tiny.onnx", names, boxes, named=False)))
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
