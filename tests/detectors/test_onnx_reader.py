"""Model families of files, and the detector built from the options."""

from pathlib import Path

import numpy as np
import pytest
from tiny_grounding import VOCABULARY, write_tiny_grounding
from tiny_yolo import write_boxes_only, write_tiny_yolo

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, KernelError, ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.relevance import DetectedBox
from gausslite.perception.detector import Detector
from gausslite.perception.detector_file import DetectorOptions
from gausslite_detectors.boxes import SegmentedDetector
from gausslite_detectors.layouts import ModelFamily
from gausslite_detectors.model_file import choose_providers, open_model
from gausslite_detectors.models import READER, inspect
from gausslite_detectors.tiles import TiledDetector

# in the network's pixels; in the image columns 32 to 64, rows 16 to 48
CUP = (24.0, 32.0, 16.0, 16.0, 0, 0.9)


def frame() -> Frame:
    """Return a frame of 128x64 pixels with a red square before a wall."""
    rgb, depth_m = np.zeros((64, 128, 3), np.uint8), np.full((64, 128), 1.0, np.float32)
    rgb[16:48, 32:64, 0] = 255
    depth_m[20:44, 36:60] = 0.5
    return Frame(0, 0, rgb, depth_m, Camera(100, 100, 64, 32, 128, 64), np.eye(4))


def yolo(tmp_path: Path, name: str = "yolo.onnx", classes=("cup", "chair"), boxes=(CUP,)) -> Path:
    return write_tiny_yolo(tmp_path / name, classes, boxes)


def opened(path: Path, segmenter: str | None = None) -> Detector:
    return READER.open(path, DetectorOptions(segmenter, threads=1))


def found_pixels(detector: Detector) -> int:
    (found,) = detector.detect(frame(), ["cup"])
    return int(found.mask.sum())


def test_a_family_is_identified_by_inputs_and_outputs(tmp_path):
    grounding = write_tiny_grounding(tmp_path / "dino.onnx", [((0.5, 0.5, 0.2, 0.2), {})])
    assert inspect(grounding).family is ModelFamily.GROUNDING_DINO
    assert inspect(yolo(tmp_path)).family is ModelFamily.YOLO_SEG
    boxes = write_boxes_only(tmp_path / "boxes.onnx", ("cup", "chair"), [CUP])
    assert inspect(boxes).family is ModelFamily.YOLO_BOXES
    # rows of box, objectness and classes, as other detectors have them
    other = write_boxes_only(tmp_path / "other.onnx", ("cup", "chair"), [CUP], more_rows=1)
    with pytest.raises(ModelFileError, match="expected a detector, got boxes with objectness, as YOLOv5 and YOLOX"):
        inspect(other)


def test_boxes_with_class_names_get_masks_from_depth(tmp_path):
    """As an export of YOLO-World whose classes were set before the export: [1, 4+c, A] and names in the metadata."""
    path = write_boxes_only(tmp_path / "world.onnx", ("wall clock", "cup"), [(24.0, 32.0, 16.0, 16.0, 1, 0.8)])
    detector = opened(path)
    (found,) = detector.detect(frame(), ["mug", "clock"])
    assert (found.phrase, found.score) == ("mug", pytest.approx(0.8))
    assert found.box_px == pytest.approx((32, 16, 64, 48))
    assert found.mask.sum() == 24 * 24
    pytest.raises(InvalidInputError, opened, path, "yolo").match("finds boxes only; expected depth or a FastSAM file")
    with pytest.raises(InvalidInputError, match=r"expected depth or a FastSAM file, got .*world\.onnx"):
        opened(path, str(path))


def test_a_detector_is_tiled_on_request(tmp_path):
    options = DetectorOptions(threads=1, tiles_per_side=3, time_limit_s=2.0)
    assert isinstance(READER.open(yolo(tmp_path), options), TiledDetector)
    assert not isinstance(opened(yolo(tmp_path)), TiledDetector)


@pytest.mark.parametrize("name", [None, "yolo"])
def test_a_yolo_file_uses_its_own_masks(tmp_path, name):
    detector = opened(yolo(tmp_path), name)
    assert found_pixels(detector) > 0.97 * 32 * 32


@pytest.mark.parametrize(("segmenter", "sessions"), [(None, 1), ("depth", 1), ("everything.onnx", 2)])
def test_each_file_is_opened_once(tmp_path, monkeypatch, segmenter, sessions):
    import onnxruntime

    paths, session_of = [], onnxruntime.InferenceSession

    def counted(path, *more, **named):
        paths.append(path)
        return session_of(path, *more, **named)

    monkeypatch.chdir(tmp_path)
    yolo(tmp_path, "everything.onnx", ("object",))
    monkeypatch.setattr(onnxruntime, "InferenceSession", counted)
    opened(yolo(tmp_path), segmenter)
    assert len(paths) == len(set(paths)) == sessions


def test_the_depth_segmenter_replaces_a_networks_masks_on_request(tmp_path):
    assert found_pixels(opened(yolo(tmp_path), "depth")) == 24 * 24


def test_a_second_file_segments_boxes_and_depth_segments_the_rest(tmp_path):
    everything = yolo(tmp_path, "everything.onnx", ("object",))
    assert found_pixels(opened(yolo(tmp_path), str(everything))) > 0.97 * 32 * 32
    blind = yolo(tmp_path, "blind.onnx", ("object",), ())
    assert found_pixels(opened(yolo(tmp_path), str(blind))) == 24 * 24


def test_boxes_without_a_mask_are_dropped():
    class TwoBoxes:
        def matches(self, queries):
            return (NounMatch(queries[0], MatchBasis.NONE),)

        def boxes(self, frame, queries):
            return [DetectedBox(queries[0], 0.9, (32, 16, 64, 48)), DetectedBox(queries[0], 0.8, (0, 0, 9, 9))]

        def best_boxes(self, frame, queries):
            return self.boxes(frame, queries)[:1]

    class LeftHalf:
        def segment(self, frame, boxes_px):
            return [np.ones(frame.depth_m.shape, np.bool_) if box[0] > 0 else None for box in boxes_px]

    detector = SegmentedDetector(TwoBoxes(), [LeftHalf(), LeftHalf()])
    assert [each.score for each in detector.detect(frame(), ["cup"])] == [0.9]
    assert [each.is_searched for each in detector.matches(["cup"])] == [False]


def test_grounding_dino_needs_a_vocabulary_and_has_no_masks(tmp_path):
    path = write_tiny_grounding(tmp_path / "dino.onnx", [((0.5, 0.5, 0.2, 0.2), {})])
    pytest.raises(InvalidInputError, opened, path, "yolo").match("finds boxes only; expected depth or a FastSAM file")
    pytest.raises(ModelFileError, opened, path).match(r"vocab\.txt")


def test_grounding_dino_with_a_vocabulary_detects_and_segments(tmp_path):
    path = write_tiny_grounding(tmp_path / "dino.onnx", [((0.375, 0.5, 0.25, 0.5), {"mug": 2.0})], (64, 128))
    (tmp_path / "vocab.txt").write_text("\n".join(VOCABULARY), encoding="utf-8")
    try:
        detector = opened(path)
    except KernelError as error:
        pytest.skip(str(error))
    (found,) = detector.detect(frame(), ["mug"])
    assert found.box_px == pytest.approx((32, 16, 64, 48))
    assert found.mask.sum() == 24 * 24


def test_a_gpu_provider_is_preferred_and_the_cpu_is_the_fallback():
    cpu, cuda, tensorrt = "CPUExecutionProvider", "CUDAExecutionProvider", "TensorrtExecutionProvider"
    assert choose_providers([cpu]) == (cpu,)
    assert choose_providers([tensorrt, cuda, cpu]) == (cuda, cpu)
    assert choose_providers([tensorrt, cpu]) == (tensorrt, cpu)
    assert choose_providers(["AzureExecutionProvider", cpu]) == (cpu,)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "a Git LFS pointer"),
        (b"\n<!DOCTYPE html><html>", "a web page"),
        (b"PK\x03\x04rest", "a zip archive"),
        (b"\x1c\x00\x00\x00ORTM", "ORT format"),
        (b"\x08\x08", "without a graph"),
        (b"\x08\x08\x3a\x7f1234", "truncated at 8 bytes of 131"),
    ],
)
def test_invalid_files_are_rejected_before_a_session_is_made(tmp_path, content, expected):
    path = tmp_path / "model.onnx"
    path.write_bytes(content)
    pytest.raises(ModelFileError, open_model, path, 1).match(expected)


def test_a_damaged_bit_is_detected_by_a_listed_checksum(tmp_path):
    path = yolo(tmp_path)
    (tmp_path / "SHA256SUMS").write_text(f"{'0' * 64}  other.onnx\n{'1' * 64} *yolo.onnx\n", encoding="utf-8")
    pytest.raises(ModelFileError, opened, path).match("of SHA256SUMS in its folder")
