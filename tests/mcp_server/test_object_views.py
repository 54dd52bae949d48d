"""Views of objects and goals beside them: what hides an object, what a robot can reach, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from small_room import BOX_M, UP, write_room

from gausslite.domain.errors import InvalidInputError, MismatchError
from gausslite.domain.pose import UpAxis, require_rigid
from gausslite_export.occupancy import FREE
from gausslite_mcp.goals import GoalSettings, goal_near
from gausslite_mcp.object_views import ObjectSight, best_view, look_at
from gausslite_mcp.place import RunPlace, find_object

BEHIND_THE_WALL, BESIDE, ABOVE, TO_THE_GAP = (-1.5, -1.0, 0.7), (1.0, -1.6, 1.0), (2.2, 0.8, 1.6), (-2.8, 1.6, 1.0)
SMALL = GoalSettings(radius_m=0.1, distance_m=0.6)


def room(folder: Path, *eyes_m: tuple[float, float, float]) -> RunPlace:
    return RunPlace(write_room(folder / "run", list(eyes_m)), threads=1)


def test_the_best_view_is_not_through_a_wall(tmp_path: Path) -> None:
    place = room(tmp_path, BEHIND_THE_WALL, BESIDE, BEHIND_THE_WALL)
    cube = find_object(place.objects(), "cube").landmark
    view = best_view(place.scene(), cube)
    assert view.T_world_camera[0, 3] > 0
    assert view.visible > 0.9
    assert ObjectSight(place.scene(), cube).look(np.array(BEHIND_THE_WALL)).visible < 0.1
    rgb = place.scene().render(view.camera, view.T_world_camera).rgb
    assert rgb[240, 320, 0] > 3 * rgb[240, 320, 1]


def test_an_object_that_no_keyframe_saw_and_one_without_gaussians_are_refused(tmp_path: Path) -> None:
    place = room(tmp_path, BEHIND_THE_WALL)
    with pytest.raises(InvalidInputError, match="object lamp-3: expected Gaussians of the map in its box, got none"):
        best_view(place.scene(), find_object(place.objects(), "lamp").landmark)
    with pytest.raises(InvalidInputError, match="expected the id or the noun of an object, got 'sofa'; ids are cube-1"):
        find_object(place.objects(), "sofa")


def test_without_keyframes_places_around_the_object_are_tried(tmp_path: Path) -> None:
    place = room(tmp_path)
    assert best_view(place.scene(), find_object(place.objects(), "cube").landmark).visible > 0.8


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_a_view_has_no_roll(up: UpAxis) -> None:
    for eye_m in ((1.0, 2.0, 0.5), (0.0, 0.0, 3.0), (0.0, -3.0, 0.0)):
        T = look_at(np.array(eye_m), np.zeros(3), np.array(up))
        require_rigid("T", T)
        np.testing.assert_allclose(T[:3, 2], -np.array(eye_m) / np.linalg.norm(eye_m), atol=1e-9)
        assert T[:3, 1] @ up < 1e-6  # rows of the image go down
    pytest.raises(InvalidInputError, look_at, np.zeros(3), np.zeros(3), UP).match("away from what it looks at")


def test_a_goal_is_free_reachable_near_and_sees_the_object(tmp_path: Path) -> None:
    place = room(tmp_path, BEHIND_THE_WALL, BESIDE, ABOVE)
    cube = find_object(place.objects(), "cube").landmark
    goal = goal_near(place.scene(), cube, SMALL)
    grid = place.scene().floor()
    column, row = ((np.array(goal.position_m[:2]) - grid.origin_m) / grid.cell_m).astype(int)
    assert grid.cells[row, column] == FREE
    assert goal.position_m[2] == pytest.approx(0.0, abs=0.06)
    assert 0.3 < goal.distance_m < 1.2
    assert goal.visible > 0.5
    toward = BOX_M[:2] - goal.position_m[:2]
    assert goal.yaw_rad == pytest.approx(np.arctan2(toward[1], toward[0]), abs=0.02)
    np.testing.assert_allclose(goal.T_world_camera[:3, 3], (*goal.position_m[:2], goal.position_m[2] + 1.0), atol=1e-6)


def test_a_goal_behind_a_wall_or_for_a_robot_too_wide_is_no_goal(tmp_path: Path) -> None:
    place = room(tmp_path, BESIDE, ABOVE, TO_THE_GAP, TO_THE_GAP)
    cube = find_object(place.objects(), "cube").landmark
    around = goal_near(place.scene(), cube, SMALL, from_m=(-1.5, 1.0, 0.0))  # through the gap
    assert around.position_m[0] > 0
    for settings, from_m in (
        (GoalSettings(radius_m=0.9), (-1.5, 1.0, 0.0)),  # the floor of the gap is 0.8 m wide
        (SMALL, (9.0, 9.0, 0.0)),
    ):
        with pytest.raises(MismatchError, match="expected a free place within 2 m that can be reached and sees it"):
            goal_near(place.scene(), cube, settings, from_m)
