"""What changed between two maps: only what later views see through, or earlier ones saw empty."""

from dataclasses import replace

import numpy as np
import pytest
from place_scenes import CAMERA, MapCamera
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.mapping.free_space import DepthView
from gausslite_objects.changes import Change, ChangeKind, compare_visits, with_earlier_objects
from gausslite_objects.life import LifeState, life_of
from gausslite_objects.visit import Visit, depth_view

WALL_M, BOX_M = 3.0, 0.4
HERE, THERE, OUTSIDE = (-0.5, 0.0, 2.0), (0.5, 0.1, 2.0), (6.0, 0.0, 2.0)


def _grid(centre_m: tuple[float, float, float], side_m: float) -> np.ndarray:
    steps = np.arange(-side_m / 2, side_m / 2 + 0.01, 0.05)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    return np.stack([x, y, np.zeros(len(x))], axis=1) + centre_m


def _scene(*boxes_m: tuple[float, float, float]) -> Gaussians:
    """Return a grey wall and red faces before it."""
    faces = [_grid(box_m, BOX_M) for box_m in boxes_m]
    points_m = np.concatenate([_grid((0.0, 0.0, WALL_M), 4.0), *faces])
    reds = np.arange(len(points_m)) >= len(points_m) - sum(map(len, faces))
    rgb = np.where(reds[:, None], (0.9, 0.1, 0.1), (0.5, 0.5, 0.5))
    return plain_gaussians(points_m, rgb=rgb, active=reds, opacities=0.95)


def _mug(centre_m: tuple[float, float, float], number: int = 1) -> ObjectLandmark:
    low, high = (tuple(value + sign * 0.25 for value in centre_m) for sign in (-1, 1))
    box = AxisAlignedBox(low, high)  # type: ignore[arg-type]
    return ObjectLandmark(f"mug-{number}", "mug", ObjectRole.TARGET, centre_m, box, 0.9, 0, 1)


def _visit(boxes_m: list[tuple[float, float, float]], objects: list[ObjectLandmark], views: int = 4) -> Visit:
    gaussians = _scene(*boxes_m)
    camera, seen = MapCamera(gaussians), []
    for index in range(views):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.1 * index
        rendering = camera.render(CAMERA, T_world_camera)
        seen.append(depth_view(rendering.expected_depth_m(0.8), CAMERA, T_world_camera))
    return Visit(gaussians, objects, seen, range(views))


def test_the_same_place_has_no_changes() -> None:
    visit = _visit([HERE], [_mug(HERE)])
    assert compare_visits(visit, _visit([HERE], [_mug((-0.45, 0.05, 2.0))])) == []


def test_a_named_object_is_moved_gone_or_new() -> None:
    here, there, nowhere = _visit([HERE], [_mug(HERE)]), _visit([THERE], [_mug(THERE)]), _visit([], [])
    [moved] = compare_visits(here, there)
    assert (moved.kind, moved.before_m, moved.after_m) == (ChangeKind.MOVED, HERE, THERE)
    size = "mug of 0.50 x 0.50 x 0.50 m"
    assert moved.describe() == f"{size}: moved 1.00 m from (-0.50, 0.00, 2.00) m to (0.50, 0.10, 2.00) m"
    [gone] = compare_visits(here, nowhere)
    assert gone.describe() == f"{size}: gone from (-0.50, 0.00, 2.00) m"
    [new] = compare_visits(nowhere, there)
    assert new.describe() == f"{size}: new at (0.50, 0.10, 2.00) m"


def test_what_one_run_does_not_see_is_unknown() -> None:
    here, nothing = _visit([HERE], [_mug(HERE)]), _visit([], [], views=0)
    for before, after, line in (
        (here, nothing, "unknown at (-0.50, 0.00, 2.00) m, out of view in the later run"),
        (nothing, here, "unknown at (-0.50, 0.00, 2.00) m, out of view in the earlier run"),
        (_visit([OUTSIDE], [_mug(OUTSIDE)]), here, "unknown at (6.00, 0.00, 2.00) m, out of view in the later run"),
    ):
        [unknown] = [change for change in compare_visits(before, after) if change.kind is ChangeKind.UNKNOWN]
        assert unknown.describe() == f"mug of 0.50 x 0.50 x 0.50 m: {line}"


@pytest.mark.parametrize(
    ("boxes_m", "place_m", "state"),
    [
        ([HERE], HERE, LifeState.PRESENT),
        ([], HERE, LifeState.ABSENT),
        ([(-0.35, 0.0, 1.4)], HERE, LifeState.OCCLUDED),
        ([HERE], OUTSIDE, LifeState.OUT_OF_VIEW),
    ],
)
def test_a_thing_is_present_absent_occluded_or_out_of_view(
    boxes_m: list[tuple[float, float, float]], place_m: tuple[float, float, float], state: LifeState
) -> None:
    life = life_of(_grid(place_m, 0.3).astype(np.float32), _visit(boxes_m, []))
    assert life.state is state
    assert life.confidence(0.8) == (0.0 if state is LifeState.ABSENT else 0.8)
    assert life.shown_ns == (3 if state is LifeState.PRESENT else None)
    assert life.absent_ns == (3 if state is LifeState.ABSENT else None)


@pytest.mark.parametrize(("shift_m", "share"), [(0.055, 0.0), (0.12, 1.0)])
def test_what_lies_within_the_errors_of_poses_from_a_surface_is_not_gone(shift_m: float, share: float) -> None:
    life = life_of(_grid(HERE, 0.3).astype(np.float32), _visit([(-0.5, 0.0, 2.0 + shift_m)], []))
    assert (life.empty_share, life.state is LifeState.PRESENT) == (share, share == 0.0)


def test_what_a_single_view_measures_is_no_thing() -> None:
    """The camera of the kitchenette measures half the distance on some pixels of one image."""
    once = _visit([HERE], [])
    ghost = Visit(once.gaussians, [], [once.views[0], *_visit([], []).views[1:]], range(4))
    assert compare_visits(ghost, _visit([], [])) == []
    assert compare_visits(Visit(once.gaussians, [], once.views[:1], [0]), _visit([], [])) == []


def test_an_object_that_was_missed_but_whose_surface_stays_is_not_gone() -> None:
    assert compare_visits(_visit([HERE], [_mug(HERE)]), _visit([HERE], [])) == []


def test_surfaces_without_a_name_are_reported() -> None:
    [moved] = compare_visits(_visit([HERE], []), _visit([THERE], []))
    assert (moved.kind, moved.noun) == (ChangeKind.MOVED, "")
    assert moved.distance_m == pytest.approx(1.0, abs=0.05)
    [gone] = compare_visits(_visit([HERE], []), _visit([], []))
    assert gone.describe().startswith("something of 0.4")
    assert gone.size_m[:2] == pytest.approx((BOX_M, BOX_M), abs=0.03)
    assert gone.as_json()["before_m"] == pytest.approx(list(HERE), abs=0.06)


@pytest.mark.parametrize(("step_m", "kinds"), [(0.4, [ChangeKind.GONE]), (0.02, [])])
def test_thin_bars_are_a_thing_only_if_several_sides_show_them(step_m: float, kinds: list[ChangeKind]) -> None:
    columns, rows = np.meshgrid(np.arange(CAMERA.width_px) + 0.5, np.arange(CAMERA.height_px) + 0.5)
    y_m = 2.0 * (rows - CAMERA.cy_px) / CAMERA.fy_px
    views: list[list[DepthView]] = [[], []]
    for index in range(-2, 3):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = step_m * index
        x_m = 2.0 * (columns - CAMERA.cx_px) / CAMERA.fx_px + step_m * index
        # two pixels wide, with four pixels between
        bar = (np.abs(x_m) < 0.2) & (np.abs(y_m) < 0.3) & (x_m % (12.0 / CAMERA.fx_px) < 4.0 / CAMERA.fx_px)
        for seen, is_there in zip(views, (bar, np.zeros_like(bar)), strict=True):
            seen.append(depth_view(np.where(is_there, 2.0, WALL_M).astype(np.float32), CAMERA, T_world_camera))
    before, after = (Visit(_scene(), [], seen, range(5)) for seen in views)
    assert [change.kind for change in compare_visits(before, after)] == kinds


@pytest.mark.parametrize(("share", "kinds"), [(0.6, [ChangeKind.GONE]), (0.29, [])])
def test_the_rim_of_what_the_other_visit_does_not_see_is_no_change(share: float, kinds: list[ChangeKind]) -> None:
    columns, rows = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    is_board = (np.abs(columns - CAMERA.cx_px) < 60) & (np.abs(rows - CAMERA.cy_px) < 60)
    depths_m = np.where(is_board, 2.0, WALL_M), np.where(columns < share * CAMERA.width_px, WALL_M, 0.0)
    views = ([depth_view(depth_m.astype(np.float32), CAMERA, np.eye(4))] * 2 for depth_m in depths_m)
    before, after = (Visit(_scene(), [], seen, range(2)) for seen in views)
    assert [change.kind for change in compare_visits(before, after)] == kinds


def test_earlier_objects_come_along_unless_they_changed_or_were_found_again() -> None:
    handle_m = (THERE[0] + 0.1, *THERE[1:])  # a part of the mug that is gone, as an object of its own
    part = replace(_mug(handle_m, 4), extent_m=AxisAlignedBox.around(_grid(handle_m, 0.1)))
    earlier = [_mug(HERE, 1), _mug(THERE, 2), _mug(OUTSIDE, 3), part]
    found = [_mug((6.05, 0.0, 2.0), 1)]
    changes = [Change(ChangeKind.GONE, "mug", (0.5, 0.5, 0.5), THERE)]
    objects = with_earlier_objects(found, earlier, changes)
    assert [(item.object_id, item.centroid_m) for item in objects] == [
        ("mug-1", (6.05, 0.0, 2.0)),
        ("mug-1-earlier", HERE),
    ]
