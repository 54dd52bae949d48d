"""Keyframes are selected for what they add to the coverage of the region and of the mission."""

import numpy as np
import pytest
from fusion_running import CAMERA, GRID, frame

from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.keyframes import Keyframe
from gausslite_refinement.keyframe_selection import Coverage, KeyframeSelection, SelectedKeyframe


def pose(x_m: float, yaw_deg: float = 0.0) -> np.ndarray:
    yaw = np.deg2rad(yaw_deg)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T_world_camera[0, 3] = x_m
    return T_world_camera


def keyframe(index: int, T_world_camera: np.ndarray | None = None, roi: bool = False) -> Keyframe:
    view = frame(index, CAMERA, pose(0.0) if T_world_camera is None else T_world_camera)
    mask = np.zeros(view.depth_m.shape, np.bool_)
    mask[8:16, 8:24] = roi
    return Keyframe(view, RelevanceMap(mask.astype(np.float32), mask.astype(np.int16) - np.int16(1)))


def test_a_view_of_the_same_place_is_not_selected_again() -> None:
    selection = KeyframeSelection(10, GRID)
    assert selection.select(keyframe(0)) is not None
    assert selection.select(keyframe(1)) is None
    assert selection.select(keyframe(2, pose(0.02))) is None
    assert selection.select(keyframe(3, pose(4.0))) is not None
    assert selection.select(keyframe(4, pose(0.0, 180.0))) is not None


def test_the_region_counts_more_than_the_background() -> None:
    plain, with_roi = (
        KeyframeSelection(10, GRID).select(keyframe(0)),
        KeyframeSelection(10, GRID).select(keyframe(0, roi=True)),
    )
    assert plain is not None
    assert with_roi is not None
    assert with_roi.gain > 2 * plain.gain


def test_a_region_seen_for_the_first_time_makes_a_known_view_worth_sending() -> None:
    selection = KeyframeSelection(10, GRID)
    assert selection.select(keyframe(0)) is not None
    later = selection.select(keyframe(1, roi=True))
    assert later is not None
    assert later.replaced is None


def test_a_full_selection_exchanges_the_keyframe_with_the_smallest_loss() -> None:
    selection = KeyframeSelection(2, GRID)
    assert selection.select(keyframe(0, roi=True)) is not None
    assert selection.select(keyframe(1, pose(4.0))) is not None
    assert selection.select(keyframe(2, pose(8.0))) is None
    better = selection.select(keyframe(3, pose(12.0), roi=True))
    assert better is not None
    assert better.replaced == 1


def test_a_corrected_pose_is_sent_again() -> None:
    selection = KeyframeSelection(10, GRID)
    assert selection.select(keyframe(0)) is not None
    assert selection.select(keyframe(0), 0.0) is None
    assert selection.select(keyframe(0, pose(0.001)), 0.0) is None
    assert selection.select(keyframe(0, pose(0.02)), 0.0) is not None


def test_the_whole_mission_is_selected_as_far_as_the_limit_allows() -> None:
    """Without a minimum gain, views of the same place fill the selection up to its limit."""
    selection = KeyframeSelection(3, GRID)
    chosen = [selection.select(keyframe(index), 0.0) for index in range(6)]
    assert [each is not None for each in chosen] == [True, True, True, False, False, False]


@pytest.mark.parametrize("roi", [False, True])
def test_a_restored_selection_makes_the_same_choices(roi: bool) -> None:
    first = KeyframeSelection(10, GRID).select(keyframe(0, roi=roi))
    assert first is not None
    assert Coverage.from_bytes(first.coverage).to_bytes() == first.coverage
    restored = KeyframeSelection(10, GRID, {0: SelectedKeyframe(first.coverage, np.eye(4))})
    assert restored.select(keyframe(1, roi=roi)) is None
    assert restored.select(keyframe(0, roi=roi)) is None
