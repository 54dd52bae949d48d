"""The real detector on a real kitchen, with the two tasks of the demo."""

from pathlib import Path

import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.datasets.regions import load_voxel_regions
from gausslite.datasets.source import Source
from gausslite.domain.objects import MatchBasis
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite_detectors.class_detector import ClassDetector, load_class_detector
from gausslite_detectors.class_match import ClassMatchSettings, TextEmbeddings, match_noun
from gausslite_detectors.model_file import open_model
from gausslite_language.rules import RuleParser

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def kitchen(shared_dir: Path) -> Source:
    return open_source(str(shared_dir / "data" / "redkitchen"))


@pytest.fixture(scope="module")
def detector(shared_dir: Path) -> ClassDetector:
    return load_class_detector(open_model(shared_dir / "models" / "yolo11n-seg_int8.onnx"))


def estimator_for(text: str, kitchen: Source, detector: ClassDetector) -> TaskRelevanceEstimator:
    settings = RelevanceTrackerSettings(up_axis=kitchen.up_axis, max_frames=1)
    return TaskRelevanceEstimator(RuleParser().parse(text), detector, settings)


def test_chairs_table_and_cups_are_detected(kitchen, detector):
    found = detector.detect(kitchen.frame(kitchen.indices().index(532)), ["chair", "table", "mug"])
    count = {
        name: sum(each.phrase == name and not each.is_weak for each in found) for name in ("chair", "table", "mug")
    }
    assert count["chair"] >= 2
    assert count["table"] == 1
    assert count["mug"] == 2


def test_text_embeddings_match_nouns_to_classes_or_to_none(shared_dir, detector):
    vectors = TextEmbeddings.from_model_folder(shared_dir / "models" / "yolo11n-seg_int8.onnx")
    assert vectors is not None
    names = detector.class_names
    for noun, name in {"kitten": "cat", "shears": "scissors", "river boat": "boat"}.items():
        match = match_noun(noun, names, vectors)
        assert (match.classes, match.is_searched) == ((name,), True)
    # siblings: the nearest class is a different thing
    for noun, name in {"pliers": "scissors", "tiger": "zebra", "faucet": "sink"}.items():
        match = match_noun(noun, names, vectors)
        assert (match.classes, match.basis, match.is_searched) == ((name,), MatchBasis.SIMILAR, False)
        assert match_noun(noun, names, vectors, ClassMatchSettings(accept_similar=True)).is_searched
    for noun in ("lamp", "fan", "towel", "fire extinguisher", "pillow", "key", "mirror", "trash can"):
        assert not match_noun(noun, names, vectors).is_searched


def test_the_chair_closest_to_the_table(kitchen, detector, shared_dir):
    regions = load_voxel_regions(shared_dir / "data" / "redkitchen" / "roi_voxels.npz")
    estimator = estimator_for("Identify the chair closest to the table", kitchen, detector)
    shared = marked = 0
    for number in range(500, 996, 40):
        frame = kitchen.frame(kitchen.indices().index(number))
        roi = estimator.estimate(frame).relevance.roi
        if number >= 780:
            shared += np.count_nonzero(roi & regions["chair_3"].mask(frame))
            marked += np.count_nonzero(roi)
    assert shared / marked > 0.7
    (table,) = [each for each in estimator.landmarks if each.phrase == "table" and each.seen_count > 1]
    assert np.abs(table.centroid_m - regions["table_1"].centroid_m).max() < 0.2


def test_the_closest_chair_is_found_from_one_end_of_the_table(kitchen, detector, shared_dir):
    regions = load_voxel_regions(shared_dir / "data" / "redkitchen" / "roi_voxels.npz")
    estimator = estimator_for("Identify the chair closest to the table", kitchen, detector)
    for number in (0, 8, 20, 44, 56, 64):
        frame = kitchen.frame(kitchen.indices().index(number), (320, 240))
        roi = estimator.estimate(frame).relevance.roi
        assert not (roi & regions["chair_2"].mask(frame)).any()
        if number in (0, 8, 20):
            assert (roi & regions["chair_3"].mask(frame)).any()


def test_mugs_on_the_table_are_marked_and_absent_objects_are_not(kitchen, detector):
    mugs = estimator_for("Pick up the mug on the table", kitchen, detector)
    umbrella = estimator_for("Pick up the umbrella", kitchen, detector)
    shares = []
    for number in range(240, 480, 40):
        frame = kitchen.frame(kitchen.indices().index(number))
        shares.append(mugs.estimate(frame).relevance.roi_share)
        if number % 80 == 0:
            assert umbrella.estimate(frame).relevance.roi_share < 0.005
    assert sum(share > 0.002 for share in shares) >= 5
    assert max(shares) < 0.05
