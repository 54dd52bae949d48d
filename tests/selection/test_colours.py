"""Colour words against pixels, simulated objects and a task with two objects of one noun."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_yolo import write_boxes_only
from tool_modules import load_tool

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.task import ObjectAttributes, Predicate, Relation, TaskGraph
from gausslite.perception.detector_file import DetectorOptions
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.selector import Fit
from gausslite_detectors.models import READER
from gausslite_selection.colours import basic_terms, colour_counts, is_evaluated, match_colour, no_colours

# colours that every table of colour names gives these names
FOCAL = {
    "black": (10, 10, 12),
    "grey": (110, 110, 110),
    "white": (245, 245, 242),
    "red": (190, 25, 30),
    "orange": (245, 150, 30),
    "yellow": (250, 215, 40),
    "green": (40, 130, 60),
    "blue": (30, 80, 170),
    "purple": (110, 40, 130),
    "pink": (250, 160, 185),
    "brown": (110, 70, 30),
}


def match_word(word: str, counts: np.ndarray) -> Fit:
    return match_colour(word, counts)


def counts_of(*rgb: tuple[int, int, int]) -> np.ndarray:
    return colour_counts(np.repeat(np.array(rgb, np.uint8), 100, axis=0))


@pytest.mark.parametrize("word", basic_terms())
def test_each_basic_colour_is_surely_itself_and_no_opposite(word):
    matches = {term: match_word(term, counts_of(FOCAL[word])) for term in basic_terms()}
    assert matches[word] is Fit.YES
    assert [term for term, match in matches.items() if match is Fit.YES] == [word]
    assert list(matches.values()).count(Fit.NO) >= 6


@pytest.mark.parametrize("word", ["red", "orange", "yellow", "green", "blue", "purple", "brown"])
@pytest.mark.parametrize("brightness", [0.25, 0.5, 0.8])
def test_shading_does_not_exclude_a_colour(word, brightness):
    """Half the surface is in a shadow that scales the light; pixels have the gamma of sRGB."""
    shaded = tuple(int(255 * ((channel / 255) ** 2.2 * brightness) ** (1 / 2.2)) for channel in FOCAL[word])
    assert match_word(word, counts_of(FOCAL[word], shaded)) is Fit.YES
    assert match_word(word, counts_of(shaded)) is not Fit.NO


@pytest.mark.parametrize("gains", [(1.12, 1.0, 0.9), (0.9, 1.0, 1.12)])
def test_a_wrong_white_balance_does_not_exclude_a_colour(gains):
    for word, rgb in FOCAL.items():
        seen = tuple(int(min(255, channel * gain)) for channel, gain in zip(rgb, gains, strict=True))
        assert match_word(word, counts_of(seen)) is not Fit.NO, word


def test_words_with_shades_two_colours_and_unknown_words():
    blue, striped = counts_of(FOCAL["blue"]), counts_of(FOCAL["black"], FOCAL["white"])
    assert match_word("light blue", blue) is Fit.YES
    assert match_word("navy", blue) is Fit.YES
    assert match_word("black and white", striped) is Fit.YES
    assert match_word("black and white", counts_of(FOCAL["black"])) is Fit.NO
    assert match_word("teal", blue) is Fit.YES
    assert (is_evaluated("dark grey"), is_evaluated("transparent")) == (True, False)
    assert match_word("transparent", blue) is Fit.DOUBTFUL
    assert match_word("blue", no_colours()) is Fit.DOUBTFUL


@pytest.mark.slow
def test_no_right_colour_of_a_simulated_home_is_excluded():
    """On a home that did not serve to set the ranges; `tools/score_colours.py` scores all homes."""
    scores = load_tool("score_colours").score([4], 3, "240x180", (1.0, 1.0, 1.0))
    right, wrong = ([getattr(each, side) for each in scores.values()] for side in ("right", "wrong"))
    assert sum(sum(each.values()) for each in right) >= 8
    assert sum(each[Fit.NO] for each in right) == 0
    assert sum(each[Fit.NO] for each in wrong) >= 0.6 * sum(sum(each.values()) for each in wrong)


def frame(index: int, left=FOCAL["red"], right=FOCAL["blue"]) -> Frame:
    """Return a frame with two blocks before a grey wall."""
    rgb, depth_m = np.full((64, 128, 3), 150, np.uint8), np.full((64, 128), 2.0, np.float32)
    for columns, colour in ((slice(16, 40), left), (slice(80, 104), right)):
        rgb[20:44, columns] = colour
        depth_m[20:44, columns] = 1.0
    return Frame(index, index, rgb, depth_m, Camera(100, 100, 64, 32, 128, 64), np.eye(4))


@pytest.fixture
def detector(tmp_path):
    # the blocks in the network's pixels, which halve the image and pad 16 rows
    boxes = [(14.0, 32.0, 12.0, 12.0, 0, 0.9), (46.0, 32.0, 12.0, 12.0, 0, 0.9)]
    return READER.open(write_boxes_only(tmp_path / "m.onnx", ("cup", "chair"), boxes), DetectorOptions(threads=1))


def colours(**names: str) -> tuple[ObjectAttributes, ...]:
    return tuple(ObjectAttributes(name, colour) for name, colour in names.items())


def marked(estimator: TaskRelevanceEstimator, **blocks) -> list[tuple[int, int]]:
    """Return the target of the left and of the right block after two frames; -1 for none."""
    relevance = [estimator.estimate(frame(index, **blocks)).relevance for index in range(2)][-1]
    return [int(relevance.target[32, column]) for column in (28, 92)]


def test_an_object_of_another_colour_is_left_out_with_a_note(detector):
    graph = TaskGraph("id", "find the red mug", ("mug",), (), (), attributes=colours(mug="red"))
    estimator = TaskRelevanceEstimator(graph, detector)
    assert estimator.notes == ()
    assert marked(estimator) == [0, -1]
    assert estimator.notes == ("red 'mug': 1 of 2 objects of another colour do not count",)
    restored = TaskRelevanceEstimator(graph, detector)
    restored.restore(estimator.state())
    assert restored.notes == estimator.notes


def test_a_doubtful_colour_counts_with_a_note(detector):
    graph = TaskGraph("id", "find the red mug", ("mug",), (), (), attributes=colours(mug="red"))
    estimator = TaskRelevanceEstimator(graph, detector)
    # between red and orange
    assert marked(estimator, right=(225, 90, 50)) == [0, 0]
    assert estimator.notes == ("red 'mug': 1 of 2 objects of doubtful colour count",)


def test_an_unknown_colour_is_named_as_not_evaluated(detector):
    graph = TaskGraph("id", "find the transparent mug", ("mug",), (), (), attributes=colours(mug="transparent"))
    estimator = TaskRelevanceEstimator(graph, detector)
    assert marked(estimator) == [0, 0]
    assert estimator.notes == ("transparent 'mug': this colour is not evaluated, every 'mug' counts",)


def test_two_names_of_one_noun_are_told_apart_by_colour(detector):
    names = colours(mug="blue", mug_2="red")
    graph = TaskGraph("id", "the blue mug and the red one", ("mug", "mug_2"), (), (), attributes=names)
    assert marked(TaskRelevanceEstimator(graph, detector)) == [1, 0]


def test_an_excluded_colour_of_the_same_noun_is_left_out(detector):
    names = colours(mug_2="red")
    graph = TaskGraph("id", "the mugs but not the red one", ("mug",), (), (), attributes=names, excluded=("mug_2",))
    estimator = TaskRelevanceEstimator(graph, detector)
    assert marked(estimator) == [-1, 0]
    assert estimator.notes == ()


def test_an_anchor_of_another_colour_is_not_the_anchor(detector):
    """The blocks are 0.64 m apart: each is near the other, so only the colour tells which one is meant."""
    relation = Relation(Predicate.NEAR, "mug", "cup")
    graph = TaskGraph("id", "near the green cup", ("mug",), ("cup",), (relation,), attributes=colours(cup="green"))
    estimator = TaskRelevanceEstimator(graph, detector)
    assert marked(estimator) == [0, 0]
    assert estimator.notes[-1] == "anchor 'green cup' not seen yet: its targets are kept"
    negated = replace(graph, relations=(replace(relation, negated=True),), attributes=colours(cup="blue"))
    assert marked(TaskRelevanceEstimator(negated, detector)) == [-1, 0]
