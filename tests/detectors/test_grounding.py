"""Grounding DINO end to end with known results, and rejection of invalid files."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_grounding import VOCABULARY, TinyTokenizer, write_tiny_grounding
from tiny_yolo import write_tiny_yolo

from gausslite.domain.camera import Camera
from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import DetectedBox
from gausslite_detectors.model_file import open_model
from gausslite_detectors.open_vocabulary import GroundingDino, GroundingSettings, corners_px, phrase_scores, preprocess
from gausslite_detectors.text_features import BertTokenizer, encode_phrase

LEFT, RIGHT = (0.25, 0.5, 0.25, 0.5), (0.75, 0.5, 0.25, 0.5)
SURE, UNSURE = 2.0, -1.2
# blue at the mean of the training images adds nothing to the logits
NEUTRAL_BLUE = round(0.406 * 255)


def frame(height: int = 60, width: int = 80, blue: int = NEUTRAL_BLUE) -> Frame:
    rgb = np.full((height, width, 3), (9, 9, blue), np.uint8)
    camera = Camera(100, 100, width / 2, height / 2, width, height)
    return Frame(0, 0, rgb, np.full((height, width), 0.4, np.float32), camera, np.eye(4))


def detector(tmp_path, answers, limits: GroundingSettings | None = None, **layout) -> GroundingDino:
    return GroundingDino(
        open_model(write_tiny_grounding(tmp_path / "tiny.onnx", answers, **layout)), TinyTokenizer(), limits
    )


LAYOUTS = (
    {},
    {"size_px": (64, 64)},
    {"size_px": ("height", "width"), "length": "tokens"},
    {"size_px": (64, 64), "pixel_mask": False},
)


@pytest.mark.parametrize("layout", LAYOUTS, ids=["fitting", "padded", "open", "without pixel mask"])
def test_a_phrase_gets_its_box_in_image_pixels_for_every_input_layout(tmp_path, layout):
    found = detector(tmp_path, [(LEFT, {"mug": SURE}), (RIGHT, {"table": SURE})], **layout).boxes(frame(), ["mug"])
    (box,) = found
    assert box.phrase == "mug"
    assert box.score == pytest.approx(1 / (1 + np.exp(-SURE)), abs=2e-3)
    assert box.box_px == pytest.approx((10, 15, 30, 45))


def test_each_phrase_has_its_own_pass_in_the_order_of_the_queries(tmp_path):
    answers = [(LEFT, {"mug": SURE}), (RIGHT, {"table": SURE, "mug": 1.0})]
    found = detector(tmp_path, answers).boxes(frame(), ["table", "mug"])
    assert [(box.phrase, box.box_px[0]) for box in found] == [("table", 50), ("mug", 10), ("mug", 50)]


def test_a_box_that_matches_only_the_adjective_is_dropped(tmp_path):
    answers = [(LEFT, {"red": SURE, "mug": UNSURE}), (RIGHT, {"red": SURE, "mug": -1.0})]
    (box,) = detector(tmp_path, answers).boxes(frame(), ["red mug"])
    assert box.box_px[0] == 50


def test_thresholds_are_those_of_the_settings(tmp_path):
    answers = [(LEFT, {"mug": UNSURE})]
    assert detector(tmp_path, answers).boxes(frame(), ["mug"]) == []
    lenient = GroundingSettings(text_score=0.2)
    assert len(detector(tmp_path, answers, lenient).boxes(frame(), ["mug"])) == 1
    strict = GroundingSettings(text_score=0.2, box_score=0.24)
    assert detector(tmp_path, answers, strict).boxes(frame(), ["mug"]) == []


def test_duplicate_and_too_large_boxes_are_dropped(tmp_path):
    beside, huge = (0.26, 0.5, 0.25, 0.5), (0.5, 0.5, 0.6, 0.6)
    answers = [(beside, {"mug": 1.0}), (LEFT, {"mug": SURE}), (huge, {"mug": SURE, "table": SURE})]
    grounding = detector(tmp_path, answers)
    far = replace(frame(), depth_m=np.full((60, 80), 1.0, np.float32))
    (mug,) = grounding.boxes(far, ["mug"])
    assert mug.box_px[0] == 10
    (table,) = grounding.boxes(far, ["table"])
    assert table.box_px == pytest.approx((16, 12, 64, 48))


def test_padding_is_masked_and_has_no_effect(tmp_path):
    answers = [(LEFT, {"mug": SURE})]
    layouts = ({"size_px": (48, 64)}, {"size_px": (96, 64)}, {"size_px": (48, 200)})
    scores = [detector(tmp_path, answers, **layout).boxes(frame(blue=160), ["mug"])[0].score for layout in layouts]
    assert scores == pytest.approx([scores[0]] * 3, abs=1e-4)
    assert scores[0] > 0.8 + 1 / (1 + np.exp(-SURE)) - 0.85


def test_a_file_with_another_interface_is_refused(tmp_path):
    with pytest.raises(ModelFileError, match="expected Grounding DINO with inputs pixel_values") as caught:
        GroundingDino(open_model(write_tiny_yolo(tmp_path / "yolo.onnx", ["cup"], [])), TinyTokenizer())
    assert "\n" not in str(caught.value)


def test_a_network_too_short_for_a_word_is_refused(tmp_path):
    pytest.raises(ModelFileError, detector, tmp_path, [(LEFT, {})], length=3).match("space for 4 tokens")


def test_a_long_phrase_keeps_its_noun():
    read = encode_phrase("red red Mug", TinyTokenizer(), 5)
    assert [VOCABULARY[i] for i in read.input_ids[0]] == ["[CLS]", "red", "mug", ".", "[SEP]"]
    assert read.is_noun == (False, False, True, False, False)


def test_a_phrase_is_padded_to_the_networks_length():
    read = encode_phrase("mug", TinyTokenizer(), 7)
    assert read.input_ids.tolist() == [[2, 6, 4, 3, 0, 0, 0]]
    assert read.attention_mask.tolist() == [[1, 1, 1, 1, 0, 0, 0]]
    assert len(read.is_noun) == 7


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 40), st.integers(1, 40))
def test_an_image_keeps_its_proportions_and_fills_one_side(height, width, to_height, to_width):
    values, mask = preprocess(np.full((height, width, 3), 255, np.uint8), (to_height, to_width), keep_proportions=True)
    inside = mask[0] > 0
    rows, columns = inside.any(axis=1).sum(), inside.any(axis=0).sum()
    assert inside[:rows, :columns].all()
    assert rows == to_height or columns == to_width
    assert abs(rows / height - columns / width) <= max(1 / height, 1 / width)
    assert (values[0, :, ~inside] == 0).all()


@given(st.lists(st.tuples(*[st.floats(-0.5, 1.5, width=32)] * 4), min_size=1, max_size=5))
def test_corners_are_in_the_image_and_ordered(boxes_cxcywh):
    boxes = np.array(boxes_cxcywh, np.float32)
    boxes[:, 2:] = np.abs(boxes[:, 2:])
    corners = corners_px(boxes, (80, 60))
    assert (corners >= 0).all()
    assert (corners <= (80, 60, 80, 60)).all()
    assert (corners[:, 2:] >= corners[:, :2]).all()


def test_missing_tokens_have_probability_zero():
    scores, noun_scores = phrase_scores(np.array([[-np.inf, 1.0, 0.0, -np.inf]], np.float32), (False, False, True))
    assert scores[0] == pytest.approx(1 / (1 + np.exp(-1)))
    assert noun_scores[0] == pytest.approx(0.5)


def test_a_box_detector_is_not_a_detector():
    assert not hasattr(DetectedBox("mug", 0.5, (0, 0, 1, 1)), "mask")


def test_word_pieces_of_a_vocabulary_file(tmp_path):
    pytest.importorskip("tokenizers", reason="the word pieces of BERT come with the extra grounding")
    path = tmp_path / "vocab.txt"
    path.write_text("\n".join(word for word in VOCABULARY if word != "mug") + "\n", encoding="utf-8")
    words = path.read_text().split()
    read = encode_phrase("Red Mug", BertTokenizer(path), 8)
    assert [words[i] for i in read.input_ids[0]] == ["[CLS]", "red", "mu", "##g", ".", "[SEP]", "[PAD]", "[PAD]"]
    assert [i for i, noun in enumerate(read.is_noun) if noun] == [2, 3]


@pytest.mark.parametrize(
    ("content", "expected"),
    [(None, "found none"), (b"\xff\xfe", "expected UTF-8 text"), (b"cup\nmug\n", r"found no \[PAD\]")],
)
def test_an_invalid_vocabulary_is_refused_in_one_line(tmp_path, content, expected):
    path = tmp_path / "vocab.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ModelFileError, match=expected) as caught:
        BertTokenizer(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
