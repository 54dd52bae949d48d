"""Files of many exporters: each finds the same cup, or is refused by name with the line that exports it right."""

import json

import numpy as np
import pytest
from constant_network import write_network
from onnx import TensorProto

from gausslite.domain.camera import Camera
from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite_detectors.class_detector import ClassDetector, load_class_detector
from gausslite_detectors.class_names import COCO_NAMES
from gausslite_detectors.model_file import open_model
from gausslite_detectors.network import DetectionNetwork

NAMES = {"names": "{0: 'cup', 1: 'chair', 2: 'table'}"}
FLOAT16 = {"images": (TensorProto.FLOAT16, [1, 3, 64, 64])}
SIZED = {"images": (TensorProto.FLOAT, [1, 3, 64, 64]), "orig_target_sizes": (TensorProto.INT64, [1, 2])}
# in pixels of a letterbox of 64x64, where the image of 128x64 has the rows 16 to 48
CUP_PX = (32.0, 16.0, 64.0, 48.0)


def frame(seed: int = 0) -> Frame:
    rgb = np.random.default_rng(seed).integers(0, 256, (64, 128, 3), np.uint8)
    return Frame(0, 0, rgb, np.ones((64, 128), np.float32), Camera(100, 100, 64, 32, 128, 64), np.eye(4))


def raw(score: float = 0.9, unit: float = 1.0, classes: int = 3, rest: float = 0.0) -> np.ndarray:
    """Return [1, 4+c, 90] with a cup in the left half of the image."""
    rows = np.zeros((1, 4 + classes, 90), np.float32)
    rows[0, 4:] = rest
    rows[0, :4, 7] = np.array([24, 32, 16, 16], np.float32) * unit
    rows[0, :4, 8] = np.array([40, 32, 8, 8], np.float32) * unit
    rows[0, 4, 7] = score
    return rows


def listed(unit: float = 1.0, more: int = 0) -> np.ndarray:
    """Return the same as [1, 300, 6], as it is after suppression."""
    rows = np.zeros((1, 300, 6 + more), np.float32)
    rows[0, 0, :6] = 16 * unit, 24 * unit, 32 * unit, 40 * unit, 0.9, 0
    rows[0, 0, 6:] = 1.0
    return rows


def labelled(kind: type = np.int64) -> dict[str, np.ndarray]:
    """Return labels, boxes and scores of a stretched image."""
    boxes, scores = np.zeros((1, 5, 4), np.float32), np.zeros((1, 5), np.float32)
    boxes[0, 0], scores[0, 0] = (16, 16, 32, 48), 0.9
    return {"labels": np.zeros((1, 5), kind), "boxes": boxes, "scores": scores}


def queries(classes: int, index: int, seed: int = 0, masks: bool = False) -> dict[str, np.ndarray]:
    """Return boxes in shares and logits; query 3 is a cup of 0.9."""
    rng = np.random.default_rng(seed)
    dets = rng.uniform(0.2, 0.6, (1, 20, 4)).astype(np.float32)
    labels = rng.uniform(-9.0, -6.0, (1, 20, classes)).astype(np.float32)
    dets[0, 3], labels[0, 3, index] = (0.375, 0.5, 0.25, 0.5), np.log(9.0)
    found = {"dets": dets, "labels": labels}
    return found | ({"masks": rng.normal(size=(1, 20, 16, 16)).astype(np.float32)} if masks else {})


def cup_of_coco() -> np.ndarray:
    rows = raw(classes=80)
    rows[:, [4, 45]] = rows[:, [45, 4]]
    return rows


PROTOTYPES = np.ones((1, 32, 16, 16), np.float32)
MASKED = np.concatenate([raw(), np.ones((1, 32, 90), np.float32)], axis=1)
VARIANTS = {
    "yolo": ({"output0": raw()}, NAMES, None),
    "yolo-opset-20": ({"output0": raw()}, NAMES, None),
    "yolo-seg": ({"output0": MASKED, "output1": PROTOTYPES}, NAMES, None),
    "yolo-seg-outputs-swapped": ({"output1": PROTOTYPES, "output0": MASKED}, NAMES, None),
    "yolo-seg-16-prototypes": ({"output0": MASKED[:, :23], "output1": PROTOTYPES[:, :16]}, NAMES, None),
    "yolo-transposed": ({"output0": raw().transpose(0, 2, 1)}, NAMES, None),
    "yolo-transposed-2-classes": (
        {"output0": raw(classes=2).transpose(0, 2, 1)}, {"names": "{0: 'cup', 1: 'chair'}"}, None,
    ),
    "yolo-half": ({"output0": raw().astype(np.float16)}, NAMES, FLOAT16),
    "yolo-uint8": ({"output0": raw()}, NAMES, {"images": (TensorProto.UINT8, [1, 3, 64, 64])}),
    "yolo-channels-last": ({"output0": raw()}, NAMES, {"images": (TensorProto.FLOAT, [1, 64, 64, 3])}),
    "yolo-batch-4": ({"output0": np.repeat(raw(), 4, 0)}, NAMES, {"images": (TensorProto.FLOAT, [4, 3, 64, 64])}),
    "yolo-dynamic": (
        {"output0": raw()}, NAMES | {"imgsz": "[64, 64]"}, {"images": (TensorProto.FLOAT, ["b", 3, "h", "w"])},
    ),
    "yolo-dynamic-one-side": (
        {"output0": raw()}, NAMES | {"imgsz": "64"}, {"images": (TensorProto.FLOAT, ["b", 3, "h", "w"])},
    ),
    "yolo-shares": ({"output0": raw(unit=1 / 64)}, NAMES, None),
    "yolo-logits": ({"output0": raw(np.log(9.0), rest=-8.0)}, NAMES, None),
    "yolo-percent": ({"output0": raw(90.0)}, NAMES, None),
    "yolo-no-names-of-coco": ({"output0": cup_of_coco()}, {}, None),
    "end-to-end": ({"output0": listed()}, NAMES | {"end2end": "True"}, None),
    "end-to-end-unstated": ({"output0": listed()}, NAMES, None),
    "end-to-end-296-names": (
        {"output0": listed()}, {"names": str(["cup", *(f"thing {i}" for i in range(295))])}, None,
    ),
    "end-to-end-shares": ({"output0": listed(1 / 64)}, NAMES, None),
    "end-to-end-masks": ({"output0": listed(more=32), "output1": PROTOTYPES}, NAMES, None),
    "nms": ({"output0": listed()}, NAMES | {"args": "{'nms': True, 'half': False}"}, None),
    "rt-detr": (labelled(), NAMES, SIZED),
    "rt-detr-int32": (labelled(np.int32), NAMES, SIZED),
    "rt-detr-names-from-1": (labelled(), {"names": "{1: 'cup', 2: 'chair'}"}, SIZED),
    "d-fine-without-size": (labelled(), NAMES, None),
    "yolo-with-a-count": ({"num_dets": np.array([[1]])} | {
        "det_boxes": listed()[:, :, :4], "det_scores": listed()[:, :, 4], "det_classes": listed()[:, :, 5],
    }, NAMES, None),
    "rf-detr": (queries(91, 47), {}, None),
    "rf-detr-seg": (queries(91, 47, masks=True), {}, None),
    "rf-detr-own-classes": (queries(4, 0), {"rfdetr_notes": json.dumps(["cup", "chair", "table"])}, None),
    "rf-detr-notes-of-coco": (queries(91, 47), {"rfdetr_notes": json.dumps({"names": COCO_NAMES})}, None),
    "rf-detr-half": ({name: array.astype(np.float16) for name, array in queries(91, 47).items()}, {}, FLOAT16),
    "hugging-face": (
        {"logits": queries(80, 41)["labels"], "pred_boxes": queries(80, 41)["dets"]}, {},
        {"pixel_values": (TensorProto.FLOAT, ["b", 3, 64, 64])},
    ),
    "names-json": ({"output0": raw()}, {"names": '{"0": "cup", "1": "chair", "2": "table"}'}, None),
    "names-list": ({"output0": raw()}, {"names": '["cup", "chair", "table"]'}, None),
    "names-from-1": ({"output0": raw()}, {"names": "{1: 'cup', 2: 'chair', 3: 'table'}"}, None),
    "names-inverted": ({"output0": raw()}, {"names": "{'cup': 0, 'chair': 1, 'table': 2}"}, None),
    "names-words": ({"output0": raw()}, {"names": "cup, chair, table"}, None),
    "names-lines": ({"output0": raw()}, {"classes": "cup\nchair\ntable\n"}, None),
    "names-yaml": ({"output0": raw()}, {"names": "0: cup\n1: chair\n2: table\n"}, None),
    "names-lvis": ({"output0": raw()}, {"names": "['cup_(drink)', 'chair', 'table']"}, None),
    "names-several": ({"output0": raw()}, {"names": "['mug/cup', 'chair', 'table']"}, None),
    "names-several-commas": ({"output0": raw()}, {"names": "['Mug, cup', 'chair', 'table']"}, None),
}  # fmt: skip


def detector_of(tmp_path, outputs, metadata, inputs, opset=13) -> ClassDetector:
    path = write_network(tmp_path / "net.onnx", outputs, metadata, inputs, opset)
    return load_class_detector(open_model(path, threads=1))


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_export_finds_the_cup(tmp_path, variant):
    detector = detector_of(tmp_path, *VARIANTS[variant], opset=20 if "20" in variant else 13)
    (found,) = (box for box in detector.boxes(frame(), ["cup"]) if not box.is_weak)
    assert found.score == pytest.approx(0.9, abs=2e-3)
    assert found.box_px == pytest.approx(CUP_PX, abs=0.1)
    if detector.has_masks:
        (masked,) = (each for each in detector.detect(frame(), ["cup"]) if not each.is_weak)
        assert masked.mask.any()


REFUSED = {
    "pose": ({"output0": raw()}, NAMES | {"task": "pose"}, None, "task pose, which finds keypoints"),
    "rotated": ({"output0": raw()}, NAMES | {"task": "obb"}, None, "rotated boxes"),
    "classes": ({"output0": np.zeros((1, 1000), np.float32)}, {}, None, "classify whole images"),
    "whole batch": ({"output": np.zeros((9, 7), np.float32)}, NAMES, None, "all images of a batch, as YOLOv7"),
    "objectness": ({"output": np.zeros((1, 90, 85), np.float32)}, {}, None, "objectness, as YOLOv5 and YOLOX"),
    "heads": (
        {f"o{i}": np.zeros((1, 21, 8 >> i, 8 >> i), np.float32) for i in range(3)}, NAMES, None,
        "without its last layers",
    ),
    "mmdeploy": (
        {"dets": np.zeros((1, 9, 5), np.float32), "labels": np.zeros((1, 9), np.int64)}, NAMES, None, "MMDeploy",
    ),
    "other-names": ({"output0": raw(classes=7)}, NAMES, None, r"do not fit its 3 class names \(expected \[1, 7, A\]"),
    "no-names": ({"output0": raw()}, {}, None, r"no class names in the metadata field 'names' or in net\.txt"),
    "broken-names": ({"output0": raw()}, {"names": "{0: 'cup', 1"}, None, "class names in the metadata field 'names'"),
    "queries-no-names": (queries(4, 0), {}, None, r"model\.export\(notes=model\.class_names\)"),
    "grey": ({"output0": raw()}, NAMES, {"images": (TensorProto.FLOAT, [1, 1, 64, 64])}, r"one input \[1, 3, height"),
    "integers": ({"output0": raw()}, NAMES, {"images": (TensorProto.INT64, [1, 3, 64, 64])}, "float16 or uint8"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_unknown_is_refused_by_name(tmp_path, name):
    *parts, expected = REFUSED[name]
    with pytest.raises(ModelFileError, match=expected) as caught:
        detector_of(tmp_path, *parts)
    assert "\n" not in str(caught.value)
    assert ("AGPL" in str(caught.value)) is (name in ("pose", "rotated"))


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (raw(unit=100.0), "boxes out of range, up to 4[0-9]{3}"),
        (raw(250.0), "scores out of range, up to 250"),
        (raw(np.nan), "finite scores.*half=False"),
        (listed()[:, :, [2, 3, 0, 1, 4, 5]], "boxes out of range"),
    ],
)
def test_values_out_of_range_are_named(tmp_path, rows, expected):
    with pytest.raises(ModelFileError, match=expected):
        detector_of(tmp_path, {"output0": rows.astype(np.float32)}, NAMES | {"end2end": "True"}, None).boxes(
            frame(), ["cup"]
        )


@pytest.mark.parametrize(
    ("text", "first"),
    [
        ("cup\nchair\ntable\n", "cup"),
        ("0\tcup\n1\tchair\n2\ttable", "cup"),
        ("1 cup\n2 chair\n3 table", "cup"),
        ("0,'cup'\n1,chair\n2,table", "cup"),
        ("names:\n- cup\n- chair\n- table", "cup"),
        ('["cup", "chair", "table"]', "cup"),
        ("5 cent coin\nchair\ntable", "5 cent coin"),
        ("5 cent coin\n6 chair\n7 table", "5 cent coin"),
    ],
)
def test_names_may_stand_beside_the_file(tmp_path, text, first):
    (tmp_path / "net.txt").write_text(text, encoding="utf-8")
    assert detector_of(tmp_path, {"output0": raw()}, {}, None).class_names[0] == first


def test_a_class_without_a_name_is_named(tmp_path):
    outputs = labelled() | {"labels": np.full((1, 5), 200)}
    with pytest.raises(ModelFileError, match=r"classes below 80, which have names, got 200; state all .* in net\.txt"):
        detector_of(tmp_path, outputs, {}, SIZED).boxes(frame(), ["cup"])


def test_percents_are_known_once_and_for_all(tmp_path):
    from gausslite_detectors.layouts import ScoreScale

    scale = ScoreScale(tmp_path)
    assert scale.to_unit(np.array([40.0, 1.0], np.float32)).tolist() == pytest.approx([0.4, 0.01])
    assert scale.to_unit(np.array([0.9], np.float32)).tolist() == pytest.approx([0.009])


def test_rf_detr_is_read_as_its_own_prediction_does(tmp_path):
    """Against its published steps: sigmoid, the best pairs of query and class, corners, masks by bilinear resizing."""
    outputs = queries(91, 47, seed=3, masks=True)
    outputs["labels"] += 6.0
    network = DetectionNetwork(open_model(write_network(tmp_path / "net.onnx", outputs, {}), 1))
    output = network.run(frame())
    found = output.candidates(0.0)
    scores = 1 / (1 + np.exp(-outputs["labels"][0].astype(np.float64)))
    best = np.argsort(-scores.ravel(), kind="stable")[:20]
    assert found.rows.tolist() == (best // 91).tolist()
    assert found.classes.tolist() == (best % 91).tolist()
    np.testing.assert_allclose(found.scores, scores.ravel()[best], atol=1e-6)
    x, y, w, h = outputs["dets"][0, best // 91].T
    corners = np.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], 1) * (128, 64, 128, 64)
    np.testing.assert_allclose(found.boxes_px, corners.clip(0, (128, 64, 128, 64)), atol=1e-3)
    for mask, row in zip(output.masks(found), best // 91, strict=True):
        expected = half_pixel_bilinear(outputs["masks"][0, row], 64, 128)
        assert (mask == (expected > 0))[np.abs(expected) > 1e-4].all()


def test_an_image_is_stretched_and_normalised_as_rf_detr_does_it():
    from gausslite_detectors.network import stretched

    rgb = frame().rgb
    tensor, placed = stretched(rgb, 40, 56, (64, 128), True)
    expected = np.stack([half_pixel_bilinear(rgb[..., i] / 255.0, 40, 56) for i in range(3)])
    mean, deviation = (np.reshape(each, (3, 1, 1)) for each in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    np.testing.assert_allclose(tensor[0], (expected - mean) / deviation, atol=2e-3)
    assert (placed.scale_x, placed.scale_y) == (56 / 128, 40 / 64)


def half_pixel_bilinear(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize with pixel centres at halves and without antialiasing."""
    rows = np.clip((np.arange(height) + 0.5) * image.shape[0] / height - 0.5, 0, image.shape[0] - 1)
    columns = np.clip((np.arange(width) + 0.5) * image.shape[1] / width - 0.5, 0, image.shape[1] - 1)
    at_columns = np.array([np.interp(columns, np.arange(image.shape[1]), row) for row in image])
    return np.array([np.interp(rows, np.arange(image.shape[0]), column) for column in at_columns.T]).T
