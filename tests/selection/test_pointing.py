"""Regions that a person points at: their overlap with ground truth, and what is refused."""

import dataclasses

import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera, back_project
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.domain.relevance import Region
from gausslite.domain.task import TaskGraph
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite_selection.pointing import mask_on_image, region_at, region_on_image


@pytest.fixture(scope="module")
def home() -> tuple[list[Frame], Region]:
    """Frames of a simulated home, and the mug's exact region."""
    source = open_source("sim:home?size=160x120")
    return [source.frame(i) for i in range(0, len(source), 12)], source.regions()["mug"]


def best_view(frames: list[Frame], mug: Region) -> tuple[Frame, tuple[int, int]]:
    """Return the frame that shows most of the mug, and the row and column of a pixel in the mug's middle."""
    frame = max(frames, key=lambda frame: np.count_nonzero(mug.mask(frame)))
    rows, columns = np.nonzero(mug.mask(frame))
    nearest = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
    return frame, (int(rows[nearest]), int(columns[nearest]))


def iou(region: Region, truth: Region, frames: list[Frame]) -> float:
    masks = [(region.mask(frame), truth.mask(frame)) for frame in frames]
    shared = sum(np.count_nonzero(mask & exact) for mask, exact in masks)
    return shared / sum(np.count_nonzero(mask | exact) for mask, exact in masks)


def test_a_click_on_one_frame_gives_the_object_in_all_frames(home) -> None:
    frames, mug = home
    frame, (row, column) = best_view(frames, mug)
    region = region_on_image(frame, [(column + 0.5, row + 0.5)])
    assert iou(region, mug, frames) > 0.7


def test_a_box_gives_the_object_in_it(home) -> None:
    frames, mug = home
    frame, _ = best_view(frames, mug)
    rows, columns = np.nonzero(mug.mask(frame))
    box = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
    assert iou(region_on_image(frame, boxes_px=[box]), mug, frames) > 0.6


def test_a_point_in_the_world_gives_the_same_region_as_the_click(home) -> None:
    frames, mug = home
    frame, (row, column) = best_view(frames, mug)
    p_camera = back_project(frame.depth_m, frame.camera)[row, column]
    x, y, z = transform_points(frame.T_world_camera, p_camera[None].astype(np.float64))[0].tolist()
    assert iou(region_at((x, y, z), frames), mug, frames) > 0.7


def wall(depth_m: float) -> Frame:
    return Frame(
        7,
        0,
        np.full((60, 80, 3), 90, np.uint8),
        np.full((60, 80), depth_m, np.float32),
        Camera(90, 90, 40, 30, 80, 60),
        np.eye(4),
    )


@pytest.mark.parametrize(
    ("prompt", "depth_m", "message"),
    [
        ({"points_px": [(80, 10)]}, 1.0, "point 80,10: expected a pixel of the image of 80x60"),
        ({"points_px": [(-0.5, 10)]}, 1.0, "point -0.5,10: expected a pixel of the image of 80x60"),
        ({"points_px": [(float("nan"), 10)]}, 1.0, "point nan,10: expected a pixel of the image of 80x60"),
        ({"points_px": [(4, 10)]}, 0.0, "point 4,10: expected depth, frame 7 has none there; draw a box"),
        ({"boxes_px": [(4, 4, 9, 9)]}, 0.0, "box 4,4,9,9: expected pixels with depth, frame 7 has none there"),
        ({"boxes_px": [(9, 4, 4, 9)]}, 1.0, "box 9,4,4,9: expected left,top,right,bottom in the image of 80x60"),
        ({}, 1.0, "points: expected at least one point or box, got none"),
    ],
)
def test_a_point_outside_the_image_or_without_depth_is_refused(prompt, depth_m, message) -> None:
    with pytest.raises(InvalidInputError) as error:
        region_on_image(wall(depth_m), **prompt)
    assert str(error.value) == message


def test_a_click_whose_region_has_much_of_the_image_is_refused() -> None:
    refused = "expected one object, its region would have 100% of frame 7; "
    with pytest.raises(InvalidInputError, match=f"^point 40,30: {refused}draw a box$"):
        mask_on_image(wall(0.5), points_px=[(40, 30)])
    with pytest.raises(InvalidInputError, match=f"^target 0,0,0.5: {refused}state a radius .0,0,0.5,RADIUS. or"):
        region_at((0.0, 0.0, 0.5), [wall(0.5)])
    mask_on_image(wall(4.0), points_px=[(40, 30)])
    assert mask_on_image(wall(0.5), boxes_px=[(0, 0, 80, 60)]).any()


def test_a_click_stops_where_the_clicked_plane_ends() -> None:
    """A wall with a poster stands on a floor: pixels next to each other have almost the same depth."""
    frame = wall(4.0)
    rows, columns = np.indices(frame.depth_m.shape)
    floor = rows >= 45
    depth_m = np.where(floor, 4.0 * 15 / (rows - 29.9), 4.0).astype(np.float32)
    poster = (rows >= 20) & (rows < 30) & (columns >= 30) & (columns < 44)
    rgb = np.where(poster[..., None], 220, frame.rgb).astype(np.uint8)
    frame = dataclasses.replace(frame, depth_m=depth_m, rgb=rgb)
    on_wall = mask_on_image(frame, points_px=[(14, 25)])
    assert np.count_nonzero(on_wall) > 200
    assert np.count_nonzero(on_wall & floor) < 0.1 * np.count_nonzero(on_wall)
    on_poster = mask_on_image(frame, points_px=[(36, 25)])
    assert np.count_nonzero(on_poster ^ poster) < 0.4 * np.count_nonzero(poster)


def test_a_click_on_a_flat_thing_does_not_take_the_table(home) -> None:
    frames, _ = home
    newspaper = open_source("sim:home?size=160x120").regions()["newspaper"]
    frame, (row, column) = best_view(frames, newspaper)
    mask, exact = mask_on_image(frame, [(column + 0.5, row + 0.5)]), newspaper.mask(frame)
    assert np.count_nonzero(mask & exact) > 0.6 * np.count_nonzero(mask | exact)


def test_a_point_that_no_frame_shows_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="target 0,0,2: expected a point on a surface that a frame shows"):
        region_at((0.0, 0.0, 2.0), [wall(1.0)])


def test_what_a_person_said_is_saved_with_the_objects(home) -> None:
    frames, mug = home
    frame, (row, column) = best_view(frames, mug)
    mask = mask_on_image(frame, [(column + 0.5, row + 0.5)])
    graph = TaskGraph("id", "", (), (), ()).with_pointed(["mug"])
    first, second = (TaskRelevanceEstimator(graph, RegionDetector({})) for _ in range(2))
    first.point_at("mug", mask, frame)
    first.exclude((9.0, 9.0, 9.0))
    second.restore(first.state())
    before, after = (estimator.estimate(frame).relevance for estimator in (first, second))
    assert before.roi.any()
    np.testing.assert_array_equal(before.roi, after.roi)
    for estimator in (first, second):
        estimator.exclude(estimator.objects[0].centroid_m)
        assert not estimator.estimate(frame).relevance.roi.any()
        estimator.point_at("mug", mask, frame)
        np.testing.assert_array_equal(estimator.estimate(frame).relevance.roi, before.roi)
