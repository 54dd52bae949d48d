"""Evidence for objects: repeated observations, and misses of visible landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from observed_objects import ObservedObjects

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch, ObjectRole
from gausslite.domain.relevance import Detection
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.evidence import Evidence, LandmarkState, VisibilityCheck
from gausslite.perception.object_map import Landmark, ObjectMap, Observation, describe_landmarks
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.settings import EvidenceSettings, RelevanceTrackerSettings

CAMERA = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)


def frame_at(x_m: float = 0.0, index: int = 0, wall_m: float = 2.0) -> Frame:
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x_m
    depth_m = np.full((120, 160), wall_m, np.float32)
    return Frame(index, index * 10**9, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA, T_world_camera)


def landmark_at(z_m: float = 2.0, score: float = 0.4) -> Landmark:
    grid = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 9), np.linspace(-0.2, 0.2, 9)), axis=-1).reshape(-1, 2)
    points_m = np.column_stack([grid, np.full(len(grid), z_m)])
    return Landmark.from_observation(Observation.from_points("mug", points_m, np.zeros(3), score))


@dataclass
class ScriptedDetector:
    """A detector with one given result per call: a score, or None for no detection."""

    scores: Sequence[float | None]
    calls: int = 0

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return ()

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        score = self.scores[min(self.calls, len(self.scores) - 1)]
        self.calls += 1
        mask = np.zeros(frame.depth_m.shape, np.bool_)
        mask[50:70, 70:90] = True
        is_weak = score is not None and score < 0.25
        return [] if score is None else [Detection("mug", score, (70.0, 50.0, 90.0, 70.0), mask, is_weak=is_weak)]


def target_marked(scores: Sequence[float | None], frames: int, max_frames: int = 1) -> list[bool]:
    detector = ScriptedDetector(scores)
    estimator = TaskRelevanceEstimator(
        TaskGraph("id", "find the mug", ("mug",), (), ()), detector, RelevanceTrackerSettings(max_frames=max_frames)
    )
    return [bool(estimator.estimate(frame_at(index=index)).relevance.roi.any()) for index in range(frames)]


def test_low_scores_need_two_detections_and_high_scores_one():
    assert target_marked([0.4], 3) == [False, True, True]
    assert target_marked([0.9], 3) == [True, True, True]
    assert target_marked([0.4, None], 3) == [False, False, False]


def test_a_second_detection_of_the_same_moment_and_place_confirms_nothing():
    evidence = Evidence(EvidenceSettings())
    for time_ns, camera_m, is_witnessed in (
        (200_000_000, (0.05, 0.0, 0.0), False),
        (200_000_000, (0.2, 0.0, 0.0), True),
        (1_000_000_000, (0.0, 0.0, 0.0), True),
    ):
        for score in (0.4, 0.75):
            landmark = landmark_at(score=score)
            again = landmark_at(score=score)
            again.view_ns, again.view_camera_m = time_ns, np.array(camera_m)
            landmark.add(again)
            assert evidence.is_witnessed(landmark) is is_witnessed
            assert (evidence.state(landmark) is LandmarkState.CANDIDATE) is (score < 0.6 and not is_witnessed)
    assert evidence.is_witnessed(landmark_at(score=1.0))


def test_a_target_survives_one_missed_detection_for_each_that_found_it():
    assert target_marked([0.9, None, None, 0.4], 4) == [True, True, False, True]
    assert target_marked([0.9, None, 0.9, None, None], 5) == [True] * 4 + [False]


def test_a_weak_detection_supports_an_object_but_does_not_make_one():
    assert target_marked([0.2], 5) == [False] * 5
    assert target_marked([0.4, 0.2, 0.2, 0.2], 4) == [False] * 4
    assert target_marked([0.4, 0.4, *[None] * 3], 5) == [False] + [True] * 3 + [False]
    assert target_marked([0.4, 0.4, 0.2, *[None] * 3], 6) == [False] + [True] * 5


def known_objects(scores: Sequence[float | None]) -> int:
    estimator = TaskRelevanceEstimator(
        TaskGraph("id", "find the mug", ("mug",), (), ()),
        ScriptedDetector(scores),
        RelevanceTrackerSettings(max_frames=1),
    )
    for index in range(len(scores)):
        estimator.estimate(frame_at(index=index))
    return estimator.known_objects


def test_an_object_is_known_after_three_detections_of_which_weak_ones_count_half():
    assert (known_objects([0.9, 0.9]), known_objects([0.4, 0.4, 0.4])) == (0, 1)
    assert (known_objects([0.4, 0.4, 0.2]), known_objects([0.4, 0.4, 0.2, 0.2])) == (0, 1)
    assert known_objects([0.9, *[None] * 3, 0.9, 0.9]) == 1


def test_an_object_missed_by_most_frames_is_not_confirmed():
    assert not any(target_marked([0.4, *[None] * 9, 0.4], 11))


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (frame_at(), True),
        (frame_at(wall_m=3.0), True),  # removed object: its cells are in view
        (frame_at(wall_m=1.0), False),  # occluded
        (frame_at(wall_m=0.0), False),  # no depth
        (frame_at(x_m=3.0), False),  # out of view
    ],
)
def test_only_visible_landmarks_can_be_missed(frame, expected):
    assert VisibilityCheck(frame, frame.depth_m).is_visible(landmark_at()) is expected


def test_landmarks_farther_than_any_observation_are_not_missed():
    far_frame = frame_at(wall_m=9.0)
    far_frame.T_world_camera[2, 3] = -3.0
    assert not VisibilityCheck(far_frame, far_frame.depth_m).is_visible(landmark_at())


def test_the_order_of_observations_does_not_matter():
    rng = np.random.default_rng(0)
    observations = [
        Observation.from_points("mug", rng.uniform(-0.1, 0.1, (200, 3)), np.array([0.0, 0.0, -z]), score)
        for z, score in ((1.0, 0.3), (2.0, 0.7), (1.5, 0.5))
    ]
    for order in ((0, 1, 2), (2, 0, 1)):
        object_map = ObjectMap()
        for number in order:
            object_map.observe([observations[number]])
        object_map.observe([], lambda landmark: True)
        (mug,) = object_map.objects
        assert (mug.seen_count, mug.missed_count, mug.best_score) == (3, 1, 0.7)
        assert mug.farthest_m == pytest.approx(2.0, abs=0.05)


def cloud(phrase: str, score: float, *low_and_high_m: tuple[float, float], time_s: int = 0) -> Observation:
    axes = [np.arange(low, high, 0.03) for low, high in low_and_high_m]
    points_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    return Observation.from_points(phrase, points_m, np.zeros(3), score, time_s * 10**9)


def closest_chair() -> ObservedObjects:
    relation = Relation(Predicate.CLOSEST_TO, "chair", "table")
    graph = TaskGraph("id", "the chair closest to the table", ("chair",), ("table",), (relation,))
    return ObservedObjects(graph)


def test_the_closest_chair_is_found_from_a_part_of_the_table():
    side_chair, end_chair = (
        cloud("chair", 0.9, (0.6, 0.9), (-0.3, 0.3), (0.45, 0.5)),
        cloud("chair", 0.9, (-0.7, -0.6), (-0.3, 0.3), (-0.2, 0.2)),
    )
    parts = [cloud("table", 0.9, (-0.4, right_m), (0.0, 0.05), (-0.4, 0.4)) for right_m in (0.9, 1.6)]
    for part in parts:
        objects = closest_chair()
        objects.observe([part, side_chair, end_chair])
        assert objects.target_of(side_chair) is not None
        assert objects.target_of(end_chair) is None


def test_a_candidate_with_a_far_lower_score_does_not_decide_a_superlative():
    objects = closest_chair()
    states = []
    for time_s in range(3):
        table = cloud("table", 0.9, (-0.4, 0.4), (0.0, 0.05), (-0.4, 0.4), time_s=time_s)
        low, high = (
            cloud("chair", score, (x_m, x_m + 0.3), (-0.3, 0.3), (0.0, 0.3), time_s=time_s)
            for score, x_m in ((0.3, 0.5), (0.9, 1.5))
        )
        objects.observe([table, low, high])
        states.append(objects.state(low))
    assert states == [LandmarkState.CANDIDATE, LandmarkState.CONFIRMED, LandmarkState.KNOWN]
    assert objects.target_of(high) is not None
    assert objects.target_of(low) is None


def test_the_thing_with_more_confidence_has_the_place():
    place = ((0.0, 0.1), (0.0, 0.1), (0.0, 0.1))
    evidence, object_map = Evidence(EvidenceSettings()), ObjectMap()
    for time_s in range(2):
        nouns = (("telephone", 0.8), ("cup", 0.4), ("mug", 0.3))
        object_map.observe([cloud(noun, score, *place, time_s=time_s) for noun, score in nouns])
    assert [landmark.phrase for landmark in evidence.confirmed(object_map.objects)] == ["telephone"]
    cups = [landmark for landmark in object_map.objects if landmark.phrase != "telephone"]
    assert len(evidence.confirmed(cups)) == 2, "two words for one thing do not exclude each other"


def test_an_object_that_most_frames_miss_is_left_out_beside_a_surer_one():
    evidence = Evidence(EvidenceSettings())
    sure, missed = landmark_at(score=0.5), landmark_at(score=0.5)
    assert evidence.without_low_scores([sure, missed]) == [sure, missed]
    missed.missed_count = 2
    assert evidence.without_low_scores([sure, missed]) == [sure]


def test_doubles_are_merged_when_an_observation_makes_them_overlap():
    left, right, whole = (
        cloud("table", 0.5, (low_m, high_m), (0.0, 0.05), (0.0, 0.4))
        for low_m, high_m in ((0, 0.6), (1.4, 2), (0, 1.7))
    )
    object_map = ObjectMap()
    object_map.observe([left, right])
    assert len(object_map.objects) == 2
    object_map.observe([whole])
    assert [landmark.seen_count for landmark in object_map.objects] == [3]


def test_the_best_target_is_reported_first_and_anchors_last():
    observations = [
        cloud(*seen, (x_m, x_m + 0.1), (0, 0.1), (0, 0.1))
        for x_m, seen in enumerate([("table", 0.9), ("mug", 0.3), ("mug", 0.8)])
    ]
    object_map = ObjectMap()
    object_map.observe(observations)
    roles = {"mug": ObjectRole.TARGET, "table": ObjectRole.ANCHOR}
    described = describe_landmarks([(landmark, roles[landmark.phrase]) for landmark in object_map.objects])
    assert [(landmark.noun, landmark.confidence) for landmark in described] == [
        ("mug", 0.8),
        ("mug", 0.3),
        ("table", 0.9),
    ]


@pytest.mark.parametrize("settings", [{"min_seen": 0}, {"confident_score": -0.1}, {"min_seen_fraction": 1.1}])
def test_settings_are_checked(settings):
    pytest.raises(InvalidInputError, EvidenceSettings, **settings)
