"""A superlative selects one object by its measured extent or place."""

from __future__ import annotations

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.region import BallRegion
from gausslite.domain.task import ObjectAttributes, Superlative, TaskGraph
from gausslite.perception.ground_truth import RegionDetector
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.relevance_estimator import TaskRelevanceEstimator
from gausslite.perception.superlatives import select_extreme

UP = np.array([0.0, -1.0, 0.0])


def box_landmark(name: str, centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> Landmark:
    points_m = np.asarray(centre_m) + (np.random.default_rng(0).random((4000, 3)) - 0.5) * size_m
    return Landmark.from_observation(Observation.from_points(name, points_m))


# y points down: the tall box reaches higher, the flat one lies lower
TALL = box_landmark("tall", (-0.6, 0.0, 2.0), (0.2, 0.8, 0.2))
FLAT = box_landmark("flat", (0.0, 0.6, 2.5), (1.0, 0.1, 0.6))
SMALL = box_landmark("small", (0.7, 0.2, 1.5), (0.3, 0.3, 0.3))


@pytest.mark.parametrize(
    ("superlative", "expected"),
    [
        (Superlative.LARGEST, "flat"), (Superlative.SMALLEST, "small"), (Superlative.TALLEST, "tall"),
        (Superlative.SHORTEST, "flat"), (Superlative.WIDEST, "flat"), (Superlative.LONGEST, "flat"),
        (Superlative.NARROWEST, "tall"), (Superlative.THINNEST, "flat"), (Superlative.THICKEST, "small"),
        (Superlative.HIGHEST, "tall"), (Superlative.LOWEST, "flat"), (Superlative.LEFTMOST, "tall"),
        (Superlative.RIGHTMOST, "small"), (Superlative.NEAREST, "small"), (Superlative.FARTHEST, "flat"),
    ],
)  # fmt: skip
def test_each_superlative_selects_its_object(superlative, expected):
    assert select_extreme([TALL, FLAT, SMALL], superlative, UP, np.eye(4)).phrase == expected


def test_sides_and_distances_follow_the_camera():
    from_behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    from_behind[2, 3] = 5.0
    assert select_extreme([TALL, FLAT, SMALL], Superlative.LEFTMOST, UP, from_behind) is SMALL
    assert select_extreme([TALL, FLAT, SMALL], Superlative.NEAREST, UP, from_behind) is FLAT


@pytest.mark.parametrize(("superlative", "name"), [(Superlative.LARGEST, "ball_1"), (Superlative.SMALLEST, "ball_2")])
def test_only_the_selected_object_is_marked(superlative, name):
    camera = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)
    depth_m, rgb = np.full((120, 160), 2.0, np.float32), np.zeros((120, 160, 3), np.uint8)
    frame = Frame(0, 0, rgb, depth_m, camera, np.eye(4))
    regions = {"ball_1": BallRegion((-0.6, 0.0, 2.0), 0.4), "ball_2": BallRegion((0.6, 0.0, 2.0), 0.2)}
    graph = TaskGraph("id", "", ("ball",), (), (), attributes=(ObjectAttributes("ball", superlative=superlative),))
    roi = TaskRelevanceEstimator(graph, RegionDetector(regions)).estimate(frame).relevance.roi
    assert np.array_equal(roi, regions[name].mask(frame))
