"""TaskRelevanceEstimator on a synthetic wall: keyframes, propagation, and the relations of Sec. III-B.3."""

from dataclasses import dataclass

import numpy as np
import pytest
from observed_objects import ObservedObjects

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import POINTING, MatchBasis
from gausslite.domain.relevance import NO_TARGET, BallRegion
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.detector import RegionDetector
from gausslite.perception.lifting import best_depth_m
from gausslite.perception.object_map import Observation
from gausslite.perception.relevance import RegionRelevanceEstimator, TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite_detectors.class_match import match_noun
from gausslite_detectors.class_names import COCO_NAMES

CAMERA = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)


def frame_at(x_m: float = 0.0, index: int = 0, turn_deg: float = 0.0) -> Frame:
    """Return a frame of a wall 2 m ahead, from a camera moved sideways and turned about the vertical axis."""
    T_world_camera = np.eye(4)
    angle = np.radians(turn_deg)
    T_world_camera[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_world_camera[0, 3] = x_m
    rays_x = (np.arange(160) + 0.5 - 80) / 100
    depth = 2.0 / (np.cos(angle) - np.sin(angle) * rays_x)
    depth_m = np.broadcast_to(depth, (120, 160)).astype(np.float32)
    return Frame(index, 0, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA, T_world_camera)


def graph_of(*relations: Relation, targets: tuple[str, ...] = ("mug",)) -> TaskGraph:
    anchors = tuple(dict.fromkeys(relation.anchor for relation in relations))
    return TaskGraph("id", "a task", targets, anchors, relations)


def observation(phrase: str, *centre_m: float, radius_m: float = 0.1) -> Observation:
    rng = np.random.default_rng(0)
    return Observation.from_points(phrase, np.asarray(centre_m) + rng.uniform(-radius_m, radius_m, (300, 3)))


@dataclass
class CountingDetector:
    """A detector of regions that counts its calls."""

    inner: RegionDetector
    calls: int = 0

    def matches(self, queries):
        return self.inner.matches(queries)

    def detect(self, frame, queries):
        self.calls += 1
        return self.inner.detect(frame, queries)


MUG = BallRegion((0.0, 0.0, 2.0), 0.2)


def test_a_target_without_relations_is_marked():
    estimator = TaskRelevanceEstimator(graph_of(), RegionDetector({"mug_1": MUG}))
    relevance = estimator.estimate(frame_at()).relevance
    assert np.array_equal(relevance.roi, MUG.mask(frame_at()))
    assert set(np.unique(relevance.target)) == {NO_TARGET, 0}


def test_keyframes_are_the_first_frame_motion_and_every_nth_frame():
    detector = CountingDetector(RegionDetector({"mug": MUG}))
    estimator = TaskRelevanceEstimator(graph_of(), detector, RelevanceTrackerSettings(max_frames=4))
    calls = []
    for index, (x_m, turn_deg) in enumerate(
        [(0, 0), (0.1, 0), (0.2, 0), (0.2, 16), (0.2, 16), (1.3, 16), *[(1.3, 16)] * 4]
    ):
        estimator.estimate(frame_at(x_m, index, turn_deg))
        calls.append(detector.calls)
    assert calls == [1, 1, 1, 2, 2, 3, 3, 3, 3, 4]


@pytest.mark.parametrize(("x_m", "turn_deg"), [(0.2, 0.0), (-0.3, 0.0), (0.1, 8.0)])
def test_masks_are_propagated_between_detections(x_m, turn_deg):
    detector = CountingDetector(RegionDetector({"mug": MUG}))
    estimator = TaskRelevanceEstimator(graph_of(), detector)
    estimator.estimate(frame_at())
    moved = frame_at(x_m, 1, turn_deg)
    truth, propagated = MUG.mask(moved), estimator.estimate(moved).relevance.roi
    assert detector.calls == 1
    assert (truth & propagated).sum() / (truth | propagated).sum() > 0.85


def test_an_object_out_of_view_is_not_propagated():
    estimator = TaskRelevanceEstimator(
        graph_of(), RegionDetector({"mug": MUG}), RelevanceTrackerSettings(max_translation_m=9)
    )
    estimator.estimate(frame_at())
    assert not estimator.estimate(frame_at(5.0, 1)).relevance.roi.any()


def test_without_depth_nothing_is_marked():
    frame = frame_at()
    without_depth = Frame(0, 0, frame.rgb, np.zeros_like(frame.depth_m), CAMERA, frame.T_world_camera)
    assert (
        not TaskRelevanceEstimator(graph_of(), RegionDetector({"mug": MUG})).estimate(without_depth).relevance.roi.any()
    )


def test_rendered_depth_overrides_sensor_depth():
    sensor, rendered = frame_at(), np.zeros(frame_at().depth_m.shape, np.float32)
    rendered[0, :2] = 1.0
    assert best_depth_m(sensor, rendered)[0, :3].tolist() == [1, 1, sensor.depth_m[0, 2]]
    assert best_depth_m(sensor.without(rendered > 0), rendered)[0, :2].tolist() == [0, 0]
    assert best_depth_m(sensor, None) is sensor.depth_m


def test_a_target_with_an_unseen_anchor_is_kept_with_a_note():
    graph = graph_of(Relation(Predicate.ON, "mug", "table"))
    estimator = TaskRelevanceEstimator(graph, RegionDetector({"mug": MUG}))
    assert estimator.estimate(frame_at()).relevance.roi.any()
    assert any(note.endswith("so far for 0 of 1 'mug' objects; the others are kept") for note in estimator.notes)


def test_an_anchor_out_of_view_still_counts():
    objects = ObservedObjects(graph_of(Relation(Predicate.NEAR, "mug", "sink")))
    objects.observe([observation("sink", 0, 0, 0)])
    objects.observe([])
    assert objects.target_of(observation("mug", 0.9, 0, 0)) is not None
    assert objects.target_of(observation("mug", 1.2, 0, 0)) is None


@pytest.mark.parametrize(
    ("centre_m", "expected"),
    [((0, -0.3, 0), True), ((0.4, -0.3, 0), True), ((0, 0.3, 0), False), ((0.8, -0.3, 0), False)],
)
def test_on_means_above_within_a_horizontal_distance(centre_m, expected):
    objects = ObservedObjects(graph_of(Relation(Predicate.ON, "mug", "table")))
    objects.observe([observation("table", 0, 0, 0)])
    assert (objects.target_of(observation("mug", *centre_m)) is not None) is expected


def test_on_a_long_table_means_over_its_footprint():
    objects = ObservedObjects(graph_of(Relation(Predicate.ON, "mug", "table")))
    x, z = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-0.4, 0.4, 40))
    objects.observe([Observation.from_points("table", np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1))])
    assert objects.target_of(observation("mug", 0.9, -0.1, 0.3, radius_m=0.04)) is not None
    assert objects.target_of(observation("mug", 1.4, -0.1, 0.3, radius_m=0.04)) is None


def test_closest_to_selects_one_of_all_seen_candidates():
    objects = ObservedObjects(graph_of(Relation(Predicate.CLOSEST_TO, "chair", "table"), targets=("chair",)))
    near, far = observation("chair", 0.8, 0, 0), observation("chair", 2.0, 0, 0)
    objects.observe([observation("table", 0, 0, 0), far])
    assert objects.target_of(far) is not None
    objects.observe([near, far])
    objects.observe([near])
    assert objects.target_of(near) is not None
    assert objects.target_of(far) is None


def test_one_satisfied_relation_is_enough():
    near_sink, near_stove = (Relation(Predicate.NEAR, "mug", anchor) for anchor in ("sink", "stove"))
    objects = ObservedObjects(graph_of(near_sink, near_stove))
    objects.observe([observation("sink", 0, 0, 0), observation("stove", 5, 0, 0)])
    assert objects.target_of(observation("mug", 5.5, 0, 0)) is not None
    assert objects.target_of(observation("mug", 2.5, 0, 0)) is None


def test_partial_views_merge_to_the_true_centroid():
    objects = ObservedObjects(graph_of(Relation(Predicate.NEAR, "mug", "table")))
    for _ in range(3):
        for left in (-1.0, -0.6, -0.2):
            x, z = np.meshgrid(np.arange(left, left + 1.2, 0.02), np.arange(-0.4, 0.4, 0.02))
            objects.observe(
                [Observation.from_points("table", np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1))]
            )
    (table,) = objects.landmarks
    assert table.seen_count == 9
    assert np.abs(table.centroid_m - (0, 0, 0)).max() < 0.06


def test_the_object_on_the_desk_is_not_the_desk():
    regions = {"desk": BallRegion((0.3, 0.2, 2.0), 0.2), "book": BallRegion((0.3, -0.2, 2.0), 0.15)}
    graph = graph_of(Relation(Predicate.ON, "object", "desk"), targets=("object",))
    relevance = TaskRelevanceEstimator(graph, RegionDetector(regions)).estimate(frame_at()).relevance
    assert np.array_equal(relevance.roi, regions["book"].mask(frame_at()))


def test_pixels_of_excluded_objects_do_not_count():
    regions = {"book": BallRegion((-0.3, 0.0, 2.0), 0.15), "laptop": BallRegion((0.3, 0.0, 2.0), 0.2)}
    graph = TaskGraph("id", "everything except the laptop", ("object",), (), (), excluded=("laptop",))
    relevance = TaskRelevanceEstimator(graph, RegionDetector(regions)).estimate(frame_at()).relevance
    assert np.array_equal(relevance.roi, regions["book"].mask(frame_at()))


def test_an_excluded_object_in_front_of_a_target_is_cut_out():
    regions = {"desk": BallRegion((0.0, 0.0, 2.0), 0.4), "laptop": BallRegion((0.0, 0.0, 2.0), 0.1)}
    graph = TaskGraph("id", "the desk except the laptop", ("desk",), (), (), excluded=("laptop",))
    relevance = TaskRelevanceEstimator(graph, RegionDetector(regions)).estimate(frame_at()).relevance
    frame = frame_at()
    assert np.array_equal(relevance.roi, regions["desk"].mask(frame) & ~regions["laptop"].mask(frame))


def test_region_detector_matches_head_nouns_and_lists_unsupported_queries():
    detector = RegionDetector({"mug_1": MUG, "mug_2": BallRegion((0.4, 0, 2), 0.1), "wall": BallRegion((0, 0, 2), 3)})
    assert len(detector.detect(frame_at(), ["red mug"])) == 2
    assert len(detector.detect(frame_at(), ["cup"])) == 2
    assert len(detector.detect(frame_at(), ["object"])) == 2
    assert detector.detect(frame_at(), ["umbrella"]) == []
    cup, umbrella = detector.matches(["cup", "umbrella"])
    assert (cup.classes, cup.warning) == (("mug_1", "mug_2"), None)
    assert umbrella.warning == "no region matches 'umbrella'; the regions are mug_1, mug_2, wall"


def test_region_estimator_assigns_target_indices():
    other = BallRegion((0.5, 0, 2.0), 0.1)
    relevance = RegionRelevanceEstimator([MUG, other]).estimate(frame_at()).relevance
    assert np.array_equal(relevance.target == 1, other.mask(frame_at()))
    pytest.raises(InvalidInputError, RegionRelevanceEstimator, []).match("at least one region")


def test_nouns_match_classes_by_name_head_and_synonym():
    names = ("person", "chair", "cup", "dining table", "couch")
    expected = {
        "cup": (("cup",), MatchBasis.NAME),
        "mug": (("cup",), MatchBasis.SYNONYM),
        "wooden chair": (("chair",), MatchBasis.NAME),
        "lawn chair": (("chair",), MatchBasis.KIND),
        "wooden desk": (("dining table",), MatchBasis.SYNONYM),
        "sofa": (("couch",), MatchBasis.SYNONYM),
        "umbrella": ((), MatchBasis.NONE),
        "thing": (names, MatchBasis.GENERIC),
    }
    for noun, (classes, basis) in expected.items():
        match = match_noun(noun, names, None)
        assert (match.classes, match.basis) == (classes, basis)
        assert match.is_searched == bool(classes)


OPEN_IMAGES = (
    "Cabinetry", "Computer monitor", "Waste container", "Tap", "Chest of drawers", "Couch", "Drill (Tool)", "Sandal",
    "Coffeemaker", "Picnic basket", "Washing machine", "Spider", "Container", "Fox",
)  # fmt: skip


@pytest.mark.parametrize(
    ("noun", "name"),
    [
        ("cabinet", "Cabinetry"), ("monitor", "Computer monitor"), ("trash can", "Waste container"),
        ("dustbin", "Waste container"), ("faucet", "Tap"), ("dresser", "Chest of drawers"), ("settee", "Couch"),
        ("drill", "Drill (Tool)"), ("coffee maker", "Coffeemaker"), ("new monitor", "Computer monitor"),
    ],
)  # fmt: skip
def test_the_vocabulary_finds_the_class_of_a_noun(noun, name):
    assert match_noun(noun, OPEN_IMAGES, None).classes == (name,)


@pytest.mark.parametrize(
    ("noun", "names"),
    [
        ("plant", ("Plant", "Houseplant")), ("big plant", ("Plant", "Houseplant")), ("table", ("Table", "Desk")),
        ("sofa", ("Couch", "Sofa bed")), ("mouse", ("Mouse", "Computer mouse")), ("fruit", ("Fruit", "Banana")),
        ("houseplant", ("Houseplant",)), ("ant", ("Ant",)), ("dog", ("Dog",)), ("banana", ("Banana",)),
        ("cup", ("Coffee cup", "Mug")),
    ],
)  # fmt: skip
def test_a_noun_with_a_class_of_its_name_is_also_searched_as_its_kinds(noun, names):
    classes = (
        "Plant", "Houseplant", "Table", "Desk", "Couch", "Sofa bed", "Mouse", "Computer mouse", "Fruit", "Banana",
        "Ant", "Dog", "Hot dog", "Chair", "Coffee cup", "Mug",
    )  # fmt: skip
    assert match_noun(noun, classes, None).classes == names


@pytest.mark.parametrize("noun", ["shoe", "laundry basket", "coffee machine", "mattress", "unicorn", "crate", "pan"])
def test_a_noun_without_a_class_is_refused_with_the_nearest_names(noun):
    match = match_noun(noun, OPEN_IMAGES, None)
    assert not match.is_searched
    assert (match.basis, match.classes) == (MatchBasis.NONE, ())
    assert f"no class of the detector matches {noun!r}" in match.warning
    assert (noun != "shoe") or f"(near in meaning: 'Sandal'); {POINTING}, or" in match.warning


def test_only_classes_near_in_meaning_are_offered():
    near = {noun: match_noun(noun, COCO_NAMES, None).known for noun in ("fire extinguisher", "lamp", "dishwasher")}
    assert near == {"fire extinguisher": (), "lamp": (), "dishwasher": ("refrigerator", "microwave", "oven")}


@pytest.mark.parametrize("settings", [{"up_axis": (0.0, 0.0, 0.0)}, {"max_frames": 0}, {"max_rotation_deg": -1.0}])
def test_settings_are_checked(settings):
    pytest.raises(InvalidInputError, RelevanceTrackerSettings, **settings)
