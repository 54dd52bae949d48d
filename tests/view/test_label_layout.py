"""The names of objects do not cover each other where the page's camera starts."""

from itertools import combinations

import numpy as np
import pytest
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.voxels import AxisAlignedBox
from gausslite_view.contents import StartView
from gausslite_view.markers import label_positions_m, label_text
from gausslite_view.oriented_box import OrientedBox

VIEW = StartView((3.0, -3.0, 3.0), (0.0, 0.0, 0.5), (0.0, 0.0, 1.0))


def landmark(noun: str, centre_m: tuple[float, float, float], size_m: float) -> ObjectLandmark:
    low, high = np.subtract(centre_m, size_m / 2), np.add(centre_m, size_m / 2)
    extent = AxisAlignedBox(tuple(low.tolist()), tuple(high.tolist()))
    return ObjectLandmark(f"{noun}-1", noun, ObjectRole.TARGET, centre_m, extent, 1.0, 0, 1)


def positions_m(objects: list[ObjectLandmark]) -> np.ndarray:
    boxes = [OrientedBox.enclosing(found.corners_m, VIEW.up) for found in objects]
    return label_positions_m(objects, boxes, VIEW)


def rectangles_px(objects: list[ObjectLandmark]) -> list[tuple[float, float, float, float]]:
    """Project the labels into a window 900 pixels high; a letter is 8 pixels wide, a label 20 pixels high."""
    forward = np.subtract(VIEW.look_at_m, VIEW.position_m)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, VIEW.up) / np.linalg.norm(np.cross(forward, VIEW.up))
    rectangles = []
    for found, position_m in zip(objects, positions_m(objects), strict=True):
        offset_m = position_m - np.array(VIEW.position_m)
        focal_px = 450 / np.tan(np.deg2rad(75.0) / 2)
        x_px, y_px = (focal_px * (offset_m @ axis) / (offset_m @ forward) for axis in (right, np.cross(right, forward)))
        half_px = 4 * len(label_text(found))
        rectangles.append((x_px - half_px, x_px + half_px, y_px, y_px + 20))
    return rectangles


def overlapping(objects: list[ObjectLandmark]) -> int:
    pairs = combinations(rectangles_px(objects), 2)
    return sum(a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3] for a, b in pairs)


def test_a_mug_on_a_table_and_a_chair_beside_it_have_names_apart() -> None:
    table, chair = landmark("table", (0.0, 0.0, 0.4), 0.8), landmark("chair", (0.1, 0.0, 0.45), 0.8)
    assert overlapping([landmark("mug", (0.0, 0.0, 0.7), 0.1), table, chair]) == 0


def test_a_name_with_room_is_at_the_top_of_its_box() -> None:
    (position_m,) = positions_m([landmark("mug", (0.0, 0.0, 0.7), 0.1)])
    assert position_m == pytest.approx([0.0, 0.0, 0.75])


def test_an_object_behind_the_camera_keeps_its_place() -> None:
    behind = landmark("mug", (6.0, -6.0, 5.0), 0.1)
    assert positions_m([behind, behind])[:, 2] == pytest.approx([5.05, 5.05])


def test_no_objects_have_no_labels() -> None:
    assert positions_m([]).shape == (0, 3)


@few_examples
@given(st.lists(st.tuples(*[st.floats(-0.8, 0.8)] * 3, st.sampled_from(["mug", "chair", "coffee table"])), max_size=8))
def test_names_are_apart_in_the_start_view_and_only_moved_up(places: list[tuple[float, float, float, str]]) -> None:
    objects = [landmark(noun, (x, y, z), 0.1) for x, y, z, noun in places]
    assert overlapping(objects) == 0
    tops_m = np.array([z + 0.05 for _, _, z, _ in places])
    assert (positions_m(objects)[:, 2] > tops_m - 1e-9).all()
