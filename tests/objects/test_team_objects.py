"""Objects of a team: merging landmarks across agents, noun queries, and their persistence."""

import itertools
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st

from gausslite.codec.json import decode_object_report, encode_object_report
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig, SessionRecord
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite_objects.team_objects import MAX_COMPARISONS, MergedObjects, find_objects, group_boxes, merge_objects

GRAPH = TaskGraph("t", "Pick up the mug on the table", ("mug",), ("table",), (Relation(Predicate.ON, "mug", "table"),))
ANYTHING = MissionConfig("", "", 0.10)


def landmark(
    noun: str, centre: tuple[float, float, float], number: int = 1, half_m: float = 0.05, confidence: float = 0.5
) -> ObjectLandmark:
    low, high = (tuple(c + side * half_m for c in centre) for side in (-1, 1))
    role = ObjectRole.TARGET if noun in GRAPH.targets else ObjectRole.ANCHOR
    box = AxisAlignedBox((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    return ObjectLandmark(f"{noun}-{number}", noun, role, centre, box, confidence, 10 * number, 10 * number + 5)


def report(*landmarks: ObjectLandmark) -> ObjectReport:
    return ObjectReport(GRAPH, landmarks)


def test_two_observations_of_one_object_are_merged_with_both_observers() -> None:
    near = landmark("mug", (1.06, 0, 0), number=3, confidence=0.8)
    reports = {
        "ant": report(landmark("mug", (1, 0, 0))),
        "bee": report(near, landmark("table", (1, 0.5, 0), half_m=0.4)),
    }
    mug, table = sorted(merge_objects(reports), key=lambda found: found.landmark.noun)
    assert mug.landmark.confidence == pytest.approx(1 - 0.35**2)
    assert mug.landmark.centroid_m[0] == pytest.approx(1.03)
    assert mug.landmark.extent_m.min_m[0] == pytest.approx(0.98)
    assert mug.landmark.extent_m.max_m[0] == pytest.approx(1.08)
    assert (mug.landmark.first_seen_ns, mug.landmark.last_seen_ns) == (10, 35)
    assert [(o.agent_id, o.object_id, o.target) for o in mug.observers] == [("ant", "mug-1", 0), ("bee", "mug-3", 0)]
    assert [(o.agent_id, o.target) for o in table.observers] == [("bee", -1)]


def test_other_nouns_far_objects_and_objects_of_one_agent_stay_apart() -> None:
    reports = {
        "ant": report(landmark("mug", (0, 0, 0), 1), landmark("mug", (0.08, 0, 0), 2)),
        "bee": report(landmark("mug", (2, 0, 0)), landmark("table", (0, 0, 0))),
    }
    assert len(merge_objects(reports)) == 4


def test_each_object_merges_with_the_nearest_one() -> None:
    reports = {
        "ant": report(landmark("mug", (0, 0, 0), 1), landmark("mug", (0.12, 0, 0), 2)),
        "bee": report(landmark("mug", (0.10, 0, 0))),
    }
    observers = [[seen.object_id for seen in found.observers] for found in merge_objects(reports)]
    assert sorted(observers) == [["mug-1"], ["mug-2", "mug-1"]]


BAD_REPORTS = {
    "a room around the mug": landmark("mug", (1, 0, 0), half_m=2.0, confidence=1.0),
    "a mug beside the mug": replace(landmark("mug", (1.1, 0, 0), confidence=1.0), first_seen_ns=-1),
    "a mug where the mug is": replace(landmark("mug", (1, 0, 0), confidence=1.0), first_seen_ns=-1),
}


@pytest.mark.parametrize("bad", BAD_REPORTS.values(), ids=BAD_REPORTS)
@pytest.mark.parametrize("seed", range(3))
def test_one_agent_neither_moves_widens_nor_renames_what_others_see(bad: ObjectLandmark, seed: int) -> None:
    rng, objects = np.random.default_rng(seed), MergedObjects(SqliteStore())
    centres = [(float(x), float(y), 0.0) for x, y in rng.normal((1.0, 0.0), 0.01, (3, 2))]
    good = {name: report(landmark("mug", centre)) for name, centre in zip("abc", centres, strict=True)}
    [before] = objects.of(good, {})
    repeated = replace(bad, object_id="again")
    after = objects.of({**good, "aardvark": report(bad, repeated)}, {})
    mug = next(found.landmark for found in after if found.landmark.object_id == before.landmark.object_id)
    assert {seen.agent_id for found in after if found.landmark == mug for seen in found.observers} >= {*"abc"}
    assert np.ptp([mug.centroid_m, before.landmark.centroid_m], axis=0).max() < 0.03
    assert max(mug.size_m) < 0.15
    # after the bad agent is evicted, the object is as before
    assert objects.of(good, {}) == (before,)


def test_a_mug_between_two_mugs_does_not_make_them_one() -> None:
    reports = {name: report(landmark("mug", (x, 0, 0))) for name, x in (("ant", 0), ("bee", 0.2), ("cat", 0.1))}
    assert len(merge_objects(reports)) == 2


def test_an_object_keeps_its_id_when_agents_join_and_leave_and_after_a_restart() -> None:
    store = SqliteStore()
    reports = {"ant": report(landmark("mug", (1, 0, 0)), landmark("mug", (3, 0, 0), 2))}
    first, second = sorted(found.landmark.object_id for found in MergedObjects(store).of(reports, {}))
    assert (first, second) == ("team/mug-1", "team/mug-2")
    seen_by_both = {**reports, "aardvark": report(landmark("mug", (1, 0, 0.02), 7))}
    for later in (seen_by_both, {"aardvark": seen_by_both["aardvark"]}):
        found = {found.landmark.object_id: found.observers for found in MergedObjects(store).of(later, {})}
        assert found["team/mug-1"][0].object_id == "mug-7"
    # a new object has a new id
    [other] = MergedObjects(store).of({"ant": report(landmark("mug", (9, 0, 0)))}, {})
    assert other.landmark.object_id == "team/mug-3"
    store.save_record("", "object-ids", b"[1")
    pytest.raises(CodecError, MergedObjects, store).match("stored ids of objects")


def merge_all_pairs(reports: dict[str, ObjectReport]) -> set[frozenset[tuple[str, str]]]:
    """Return the observers of each object by the definition: all pairs that match, the nearest first."""
    landmarks = sorted(
        ((owner, mark) for owner, own in reports.items() for mark in own.objects),
        key=lambda member: (member[1].first_seen_ns, member[0], member[1].object_id),
    )
    centres = np.array([mark.centroid_m for _, mark in landmarks])
    diagonals = [float(np.linalg.norm(mark.size_m)) for _, mark in landmarks]
    pairs, repeated = [], set()
    for (i, (owner, first)), (j, (other, second)) in itertools.combinations(enumerate(landmarks), 2):
        (low, high), (low2, high2) = (
            (np.array(mark.extent_m.min_m), np.array(mark.extent_m.max_m)) for mark in (first, second)
        )
        shared = np.prod(np.maximum(np.minimum(high, high2) - np.maximum(low, low2), 0.0))
        larger = max(float(np.prod(high - low)), float(np.prod(high2 - low2)))
        alike = max(diagonals[i], diagonals[j]) <= 2.5 * min(diagonals[i], diagonals[j]) + 0.15
        overlaps = larger > 0 and shared >= 0.3 * larger
        distance = float(np.linalg.norm(centres[i] - centres[j]))
        near = distance < max(0.15, 0.5 * min(diagonals[i], diagonals[j]))
        if first.noun == second.noun and alike and (near or overlaps) and owner != other:
            pairs.append((distance, j, i))
        if first.noun == second.noun and alike and overlaps and owner == other:
            repeated.add(j)
    clusters = [[i] for i in range(len(landmarks))]
    reaches = {i: max(0.15, 0.5 * diagonal) for i, diagonal in enumerate(diagonals)}
    for _, i, j in sorted(pairs):
        a, b = (next(cluster for cluster in clusters if k in cluster) for k in (i, j))
        apart = np.linalg.norm(np.median(centres[a], axis=0) - np.median(centres[b], axis=0))
        if a is b or {i, j} & repeated or {landmarks[k][0] for k in a} & {landmarks[k][0] for k in b}:
            continue
        if len(a) + len(b) == 2 or apart < max(reaches[a[0]], reaches[b[0]]):
            clusters.remove(b)
            a += b
            reaches[a[0]] = float(np.median([reaches[a[0]], reaches[b[0]]]))
    return {frozenset((landmarks[k][0], landmarks[k][1].object_id) for k in cluster) for cluster in clusters}


@pytest.mark.parametrize("largest_group", [4, 64])
@few_examples
@given(
    seed=st.integers(0, 2**32 - 1), side_m=st.sampled_from([0.3, 1.0, 5.0]), largest_m=st.sampled_from([0.1, 0.5, 3.0])
)
def test_landmarks_are_merged_as_if_all_pairs_were_compared(
    largest_group: int, seed: int, side_m: float, largest_m: float
) -> None:
    rng = np.random.default_rng(seed)

    def random_landmark(number: int) -> ObjectLandmark:
        centre = tuple(rng.uniform(0, side_m, 3).round(2).tolist())
        return landmark(str(rng.choice(["mug", "cup"])), centre, number, float(rng.uniform(0, largest_m)))

    reports = {name: report(*map(random_landmark, range(6))) for name in "abcd"}
    with patch("gausslite_objects.team_objects._GROUP", largest_group):
        merged = merge_objects(reports)
    observers = {frozenset((seen.agent_id, seen.object_id) for seen in found.observers) for found in merged}
    assert observers == merge_all_pairs(reports)


@pytest.mark.parametrize("spread_m", [0.0, 1.0, 50.0])
def test_the_number_of_comparisons_is_bounded_however_many_landmarks_there_are(spread_m: float) -> None:
    rng = np.random.default_rng(1)
    low = rng.uniform(0, spread_m, (60 * 200, 3))
    high = low + np.where(np.arange(len(low)) % 2, 100.0, 0.1)[:, None]
    groups = group_boxes(low, high)
    assert sum(len(group) ** 2 // 2 for group in groups) <= 2 * MAX_COMPARISONS
    assert max(len(group) for group in groups) <= 1024


def test_objects_are_merged_once_until_a_report_or_a_frame_changes() -> None:
    reports, merged = {"ant": report(landmark("mug", (1, 0, 0)))}, MergedObjects(SqliteStore())
    with patch("gausslite_objects.team_objects.merge_objects", wraps=merge_objects) as merging:
        first = merged.of(reports, {})
        assert merged.of(dict(reports), {}) is first
        merged.of(reports, {"ant": np.eye(4)})
        merged.of(reports, {"ant": np.eye(4)})
        [mug] = merged.of(reports | {"ant": report(landmark("mug", (2, 0, 0)))}, {})
    assert mug.landmark.centroid_m == (2, 0, 0)
    assert merging.call_count == 3


def test_the_result_does_not_depend_on_the_order_of_the_agents() -> None:
    rng = np.random.default_rng(3)
    reports = {
        name: report(*(landmark("mug", tuple(rng.uniform(0, 0.6, 3).tolist()), i) for i in range(8))) for name in "abc"
    }
    expected = merge_objects(reports)
    for order in itertools.permutations(reports):
        assert merge_objects({name: reports[name] for name in order}) == expected


def test_a_query_finds_synonyms_and_plurals_and_moves_landmarks_to_the_fused_frame() -> None:
    reports = {"ant": report(landmark("mug", (1, 0, 0)), landmark("table", (0, 0, 0)))}
    assert [each.landmark.noun for each in find_objects(merge_objects(reports), "mug")] == ["mug"]
    assert [each.landmark.noun for each in find_objects(merge_objects(reports), " Cup ")] == ["mug"]
    assert find_objects(merge_objects(reports), "bicycle") == ()
    assert len(find_objects(merge_objects(reports))) == 2
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = (0, 0, 2)
    [moved] = find_objects(merge_objects(reports, {"ant": T}), "mug")
    assert moved.landmark.centroid_m == pytest.approx((0, 1, 2))
    assert moved.landmark.extent_m.min_m == pytest.approx((-0.05, 0.95, 1.95))
    for noun in ("\n", "x" * 1000, "  "):
        pytest.raises(InvalidInputError, find_objects, merge_objects(reports), noun).match("noun")


def test_a_landmark_that_moves_out_of_range_is_left_out_and_others_are_found() -> None:
    reports = {"ant": report(landmark("mug", (999_999, 0, 0)), landmark("table", (0, 0, 0)))}
    T = np.eye(4)
    T[0, 3] = 9000.0
    [table] = merge_objects(reports, {"ant": T})
    assert table.landmark.centroid_m == (9000.0, 0.0, 0.0)


def test_reports_survive_in_the_store_and_end_with_the_agent(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    store = SqliteStore(path)
    engine = FusionEngine(store, FusionSettings())
    session = engine.join("ant", ANYTHING).session.session_id
    engine.objects.report(SessionRecord(session, "ant"), report(landmark("mug", (1, 2, 3))))
    store.close()
    store = SqliteStore(path)
    engine = FusionEngine(store, FusionSettings())
    [mug] = engine.query_objects("mug")
    assert mug.landmark.centroid_m == (1.0, 2.0, 3.0)
    # a join with the same task keeps the objects of the report; another task has none yet
    assert len(engine.objects.of_task("ant", GRAPH)) == 1
    assert engine.objects.of_task("ant", replace(GRAPH, targets=("cup",))) == ()
    engine.leave(session, forget=True)
    assert engine.query_objects() == ()
    assert store.records("objects") == {}
    store.close()


def test_a_report_is_encoded_completely_and_damage_is_one_error() -> None:
    original = report(landmark("mug", (1, 2, 3)))
    assert decode_object_report(encode_object_report(original)) == original
    for damaged in (b"", b"[]", b'{"task_id": 1}', encode_object_report(original).replace(b"target", b"ground")):
        pytest.raises(CodecError, decode_object_report, damaged).match("object report")


def test_values_out_of_range_are_refused() -> None:
    good = landmark("mug", (0, 0, 0))
    for wrong in (
        {"noun": ""},
        {"noun": "a\nb"},
        {"object_id": "x" * 300},
        {"centroid_m": (float("nan"), 0, 0)},
        {"centroid_m": (1e9, 0, 0)},
        {"confidence": 1.5},
        {"confidence": float("nan")},
        {"first_seen_ns": 100},
    ):
        pytest.raises(InvalidInputError, replace, good, **wrong).match("object")
    pytest.raises(InvalidInputError, report, good, good).match("repeated")
    pytest.raises(InvalidInputError, report, *(landmark("mug", (0, 0, 0), i) for i in range(201))).match("at most 200")
