"""Detectors whose classes are text features: every number of the decoded boxes, the text encoder, and invalid files."""

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_prompted import DIMENSIONS, WORDS, word_vectors, write_prompted, write_text_encoder, write_tokenizer

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import POINTING, MatchBasis
from gausslite.perception.detector import Detector
from gausslite.perception.detector_file import DetectorOptions
from gausslite_detectors.class_match import NOUN_NAMES_FILE, NOUN_VECTORS_FILE
from gausslite_detectors.layouts import ModelFamily
from gausslite_detectors.model_file import open_model
from gausslite_detectors.models import READER, inspect
from gausslite_detectors.open_vocabulary import PromptedYolo
from gausslite_detectors.text_features import ClipTextEncoder, NounVectorTable

pytest.importorskip("tokenizers", reason="the text encoder needs the extra grounding")

# in pixels of the network, which scales the image by one half and pads 16 rows above and below
BOXES = ((24.0, 32.0, 16.0, 16.0), (25.0, 32.0, 16.0, 16.0), (50.0, 40.0, 12.0, 8.0))


def frame() -> Frame:
    """Return a frame of 128x64 pixels, all red, before a wall with a nearer block."""
    rgb, depth_m = np.zeros((64, 128, 3), np.uint8), np.full((64, 128), 2.0, np.float32)
    rgb[..., 0] = 255
    depth_m[20:44, 36:60] = 1.0
    return Frame(0, 0, rgb, depth_m, Camera(100, 100, 64, 32, 128, 64), np.eye(4))


def opened(path: Path, segmenter: str | None = None) -> Detector:
    return READER.open(path, DetectorOptions(segmenter, threads=1))


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def mug_vector() -> np.ndarray:
    """Return what the tiny text encoder gives for "mug": start token, word and end token, normalised."""
    return unit(word_vectors()[[1, WORDS.index("mug"), 2]].sum(axis=0))


def anchors() -> np.ndarray:
    """Return anchors that show a mug, the same mug a pixel beside, and a chair."""
    chair = unit(word_vectors()[[1, WORDS.index("chair"), 2]].sum(axis=0))
    return np.stack([8 * mug_vector(), 4 * mug_vector(), 8 * chair - 8 * (chair @ mug_vector()) * mug_vector()])


def encoder(tmp_path: Path, **kind) -> ClipTextEncoder:
    path = write_text_encoder(tmp_path / "text_encoder.onnx", **kind)
    return ClipTextEncoder(open_model(path, 1), write_tokenizer(tmp_path / "tokenizer.json"))


def expected_score(query: np.ndarray, anchor: np.ndarray) -> float:
    """Return the network's score: half of its image is red, a quarter grey padding above and below each."""
    red = (32 + 32 * np.float32(114 / 255)) / 64
    return float(red / (1 + np.exp(-query @ anchor)))


@pytest.mark.parametrize(("classes", "splits"), [("classes", False), (3, False), ("classes", True), (3, True)])
def test_every_box_and_score_is_the_networks(tmp_path, classes, splits):
    path = write_prompted(tmp_path / "world.onnx", BOXES, anchors(), classes, splits)
    vectors = encoder(tmp_path)
    detector = PromptedYolo(open_model(path, 1), vectors)
    found = detector.boxes(frame(), ["mug", "chair", "cup"])
    mugs, chairs = ([each for each in found if each.phrase == noun] for noun in ("mug", "chair"))
    # the second anchor overlaps the first by more than 0.7
    assert mugs[0].score == pytest.approx(expected_score(vectors.vector("mug"), anchors()[0]), abs=1e-5)
    assert mugs[0].box_px == pytest.approx((32, 16, 64, 48), abs=1e-4)
    assert not any(each.box_px == pytest.approx((34, 16, 66, 48), abs=1e-4) for each in mugs)
    best = max(chairs, key=lambda each: each.score)
    assert best.score == pytest.approx(expected_score(vectors.vector("chair"), anchors()[2]), abs=1e-5)
    assert best.box_px == pytest.approx((88, 40, 112, 56), abs=1e-4)


def test_more_nouns_than_the_network_has_classes_take_several_passes(tmp_path):
    path = write_prompted(tmp_path / "world.onnx", BOXES, anchors(), 1)
    one_by_one = PromptedYolo(open_model(path, 1), encoder(tmp_path))
    at_once = PromptedYolo(open_model(write_prompted(tmp_path / "wide.onnx", BOXES, anchors()), 1), encoder(tmp_path))
    queries = ["chair", "mug", "red mug"]
    expected = at_once.boxes(frame(), queries)
    assert len({each.phrase for each in expected}) == 3
    for box, other in zip(one_by_one.boxes(frame(), queries), expected, strict=True):
        assert (box.phrase, box.box_px) == (other.phrase, pytest.approx(other.box_px))
        assert box.score == pytest.approx(other.score, abs=1e-6)


@pytest.mark.parametrize("kind", [{}, {"rows": 4}, {"has_attention": True}])
def test_text_features_are_the_encoders(tmp_path, kind):
    vectors = encoder(tmp_path, **kind)
    np.testing.assert_allclose(vectors.vector("mug"), mug_vector(), atol=1e-6)
    pair = unit(word_vectors()[[1, WORDS.index("red"), WORDS.index("mug"), 2]].sum(axis=0))
    np.testing.assert_allclose(vectors.vector("Red_mug"), pair, atol=1e-6)
    assert vectors.dimensions == DIMENSIONS
    assert vectors.match("red mug").basis is MatchBasis.PHRASE


def test_a_text_that_is_too_long_keeps_its_end_token(tmp_path):
    ids = encoder(tmp_path).token_ids(" ".join(["red"] * 100))
    assert ids.shape == (1, 77)
    assert list(ids[0, [0, 1, -2, -1]]) == [1, 6, 6, 2]


def test_a_table_of_text_vectors_replaces_the_encoder(tmp_path):
    names = [{"id": 1, "name": "mug", "synonyms": ["mug", "tankard"]}, {"id": 2, "name": "chair", "synonyms": []}]
    (tmp_path / NOUN_NAMES_FILE).write_text(json.dumps(names), encoding="utf-8")
    np.save(tmp_path / NOUN_VECTORS_FILE, np.stack([3 * mug_vector(), anchors()[2]]).astype(np.float16))
    path = write_prompted(tmp_path / "world.onnx", BOXES, anchors())
    detector = opened(path)
    found = detector.detect(frame(), ["beer tankard", "umbrella"])
    assert {each.phrase for each in found} == {"beer tankard"}
    assert found[0].score == pytest.approx(expected_score(mug_vector(), anchors()[0]), abs=1e-3)
    assert found[0].mask.sum() == 24 * 24
    tankard, umbrella = detector.matches(["beer tankard", "umbrella"])
    assert (tankard.classes, tankard.is_searched) == (("tankard",), True)
    assert umbrella.warning == f"no class of the detector matches 'umbrella'; {POINTING}, or prompt a detector by text"


def test_the_registry_finds_the_encoder_beside_the_detector(tmp_path):
    path = write_prompted(tmp_path / "world.onnx", BOXES, anchors(), 81)
    assert inspect(path).family is ModelFamily.PROMPTED_YOLO
    encoder(tmp_path)
    found = opened(path).detect(frame(), ["mug"])
    assert found[0].box_px == pytest.approx((32, 16, 64, 48), abs=1e-4)
    pytest.raises(InvalidInputError, opened, path, "yolo").match("finds boxes only")
    with pytest.raises(ModelFileError, match="expected a detector, got a text encoder"):
        opened(tmp_path / "text_encoder.onnx")


def test_missing_and_wrong_text_files_are_named(tmp_path):
    path = write_prompted(tmp_path / "world.onnx", BOXES, anchors())
    pytest.raises(ModelFileError, opened, path).match(r"expected text_encoder\.onnx and tokenizer\.json, or lvis")
    write_text_encoder(tmp_path / "text_encoder.onnx")
    with pytest.raises(ModelFileError, match=r"tokenizer\.json: expected a JSON file of up to 16 MiB, found none"):
        opened(path)
    (tmp_path / "tokenizer.json").write_text("{}", encoding="utf-8")
    pytest.raises(ModelFileError, opened, path).match(r"tokenizer\.json: expected a tokenizer in JSON")
    with pytest.raises(ModelFileError, match="expected a text encoder with projected text features"):
        encoder(tmp_path, output="pooler_output")
    with pytest.raises(ModelFileError, match=r"expected token ids \[n, length\], got images"):
        ClipTextEncoder(open_model(path, 1), write_tokenizer(tmp_path / "tokenizer.json"))


def test_vectors_of_another_length_are_refused(tmp_path):
    (tmp_path / NOUN_NAMES_FILE).write_text('[{"id": 1, "name": "mug", "synonyms": []}]', encoding="utf-8")
    np.save(tmp_path / NOUN_VECTORS_FILE, np.ones((1, 5), np.float32))
    path = write_prompted(tmp_path / "world.onnx", BOXES, anchors())
    with pytest.raises(ModelFileError, match="expected text features of 8 numbers, got 5"):
        PromptedYolo(open_model(path, 1), NounVectorTable(tmp_path))
