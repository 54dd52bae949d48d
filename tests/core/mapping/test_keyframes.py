"""Keyframe selection, and the tiles of the task's region."""

from dataclasses import replace

import numpy as np
from mapping_scenes import middle_relevance, wall_frame

from gausslite.domain.camera import CameraMotion
from gausslite.domain.pose import Twist
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.keyframe_store import KeyframeStore, motion_blur_px
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.policies import UNIFORM, policy
from gausslite.mapping.settings import Components, KeyframeSettings
from gausslite.mapping.window_view import tiles_touching, window_view
from gausslite.render.cpu import CpuRasterizer


def stored(settings: KeyframeSettings, frames: int) -> KeyframeStore:
    store, rasterizer = KeyframeStore(settings), CpuRasterizer(threads=1)
    for index in range(frames):
        frame = wall_frame(index)
        store.add(window_view(Keyframe(frame, middle_relevance(frame)), rasterizer, settings))
    return store


def test_every_fifth_frame_is_kept_and_the_window_holds_the_latest() -> None:
    store = stored(KeyframeSettings(every=5, window=3, long_term_keyframes=0), 23)
    assert [view.keyframe.frame.index for view in store.window] == [10, 15, 20]
    assert [keyframe.frame.index for keyframe in store.buffer] == [0, 5, 10, 15, 20]


def test_the_buffer_is_bounded_and_stays_spread_over_the_mission() -> None:
    store = stored(KeyframeSettings(every=1, window=2, buffer=8), 64)
    kept = [keyframe.frame.index for keyframe in store.buffer]
    assert len(kept) == 8
    assert (kept[0], kept[-1]) == (0, 63)
    assert max(np.diff(kept)) <= 20


def test_sharp_frames_are_kept_instead_of_blurred_neighbours() -> None:
    """Every second frame is blurred by several pixels."""
    settings, rasterizer = (
        KeyframeSettings(every=1, window=2, buffer=8, long_term_keyframes=8),
        CpuRasterizer(threads=1),
    )
    store = KeyframeStore(settings)
    turn = Twist(np.zeros(3), np.array([0.0, 2.0, 0.0]))
    for index in range(32):
        motion = CameraMotion(turn, exposure_s=0.05 if index % 2 else 0.001)
        frame = replace(wall_frame(index), motion=motion)
        assert (motion_blur_px(frame) > 1.5) == bool(index % 2)
        store.add(window_view(Keyframe(frame, middle_relevance(frame)), rasterizer, settings))
    kept = [keyframe.frame.index for keyframe in store.buffer]
    long_term = [view.keyframe.frame.index for view in store.window[:-2]]
    for indices in (kept[1:-1], long_term[1:]):
        assert sum(index % 2 for index in indices) <= 1
    assert motion_blur_px(wall_frame(0)) == 0.0


def test_fewer_large_images_are_kept() -> None:
    pixels = wall_frame(0).depth_m.size
    settings = KeyframeSettings(every=1, window=4, buffer=8, long_term_keyframes=4, max_pixels=10 * pixels)
    store = stored(settings, 40)
    assert [keyframe.frame.index for keyframe in store.buffer][::3] == [0, 39]
    assert len(store.buffer) == 4
    assert len(store.window) <= 4
    assert store.image_bytes <= 10 * pixels * 14
    tiny = settings.for_image_size(10**9)
    assert (tiny.window, tiny.buffer, tiny.long_term_keyframes) == (1, 1, 1)
    assert KeyframeSettings().for_image_size(1280 * 720) == KeyframeSettings()
    assert KeyframeSettings(long_term_keyframes=0).for_image_size(10**9).long_term_keyframes == 0


def test_a_larger_image_evicts_several_smaller_ones() -> None:
    settings, rasterizer = (
        KeyframeSettings(every=1, window=4, buffer=8, long_term_keyframes=4),
        CpuRasterizer(threads=1),
    )
    large = wall_frame(40)
    store = KeyframeStore(replace(settings, max_pixels=5 * large.depth_m.size))
    for index in range(20):
        frame = wall_frame(index, size=(16, 12))
        store.add(window_view(Keyframe(frame, middle_relevance(frame)), rasterizer, settings))
    assert len(store.buffer) == 8
    store.add(window_view(Keyframe(large, middle_relevance(large)), rasterizer, settings))
    assert (len(store.buffer), len(store.window)) == (2, 1)
    assert store.buffer[-1].frame is large


def test_frames_that_show_the_region_stay_in_the_window_and_spread_over_the_mission() -> None:
    store = stored(KeyframeSettings(every=8, window=2, long_term_keyframes=6), 40)
    kept = [view.keyframe.frame.index for view in store.window]
    assert kept[-2:] == [24, 32]
    assert len(set(kept)) == len(kept) <= 8
    assert {0, 39} <= set(kept)
    assert max(np.diff(sorted(kept))) <= 16


def test_as_many_frames_without_the_region_as_with_it_stay_in_the_window() -> None:
    settings, rasterizer = KeyframeSettings(every=8, window=1, long_term_keyframes=6), CpuRasterizer(threads=1)
    store = KeyframeStore(settings)
    for index in range(64):
        frame = wall_frame(index)
        relevance = middle_relevance(frame) if index < 16 else RelevanceMap.empty(48, 64)
        store.add(window_view(Keyframe(frame, relevance), rasterizer, settings))
    with_region = [view.shows_roi for view in store.window]
    assert (sum(with_region), len(with_region)) == (6, 13)
    others = [view.keyframe.frame.index for view in store.window if not view.shows_roi]
    assert (others[0], others[-2:]) == (16, [63, 56])


def test_a_policy_without_a_task_keeps_as_many_views() -> None:
    settings, rasterizer = KeyframeSettings(every=8, window=2, long_term_keyframes=6), CpuRasterizer(threads=1)
    store = KeyframeStore(settings)
    for index in range(40):
        store.add(window_view(Keyframe(wall_frame(index), RelevanceMap.empty(48, 64)), rasterizer, settings))
    kept = [view.keyframe.frame.index for view in store.window]
    assert kept == [view.keyframe.frame.index for view in stored(settings, 40).window]
    store.replace(store.window[0].keyframe, lambda keyframe: window_view(keyframe, rasterizer, settings))
    assert [view.keyframe.frame.index for view in store.window] == kept
    assert not policy(UNIFORM).components.follow_task
    assert Components(sb=False, roi=False, sis=False).follow_task


def test_a_view_whose_revised_relevance_is_empty_counts_among_the_others() -> None:
    settings, rasterizer = KeyframeSettings(every=4, long_term_keyframes=6), CpuRasterizer(threads=1)
    store = stored(settings, 3)
    wrong = store.window[0].keyframe
    assert wrong.frame.index == 1
    empty = Keyframe(wrong.frame, RelevanceMap.empty(48, 64))
    store.replace(empty, lambda keyframe: window_view(keyframe, rasterizer, settings))
    assert [(view.keyframe.frame.index, view.shows_roi) for view in store.window] == [(1, False), (2, True), (0, True)]


def test_a_keyframe_is_found_by_its_frame_after_a_loop_has_moved_it() -> None:
    store = stored(KeyframeSettings(every=2), 3)
    T = np.eye(4)
    T[0, 3] = 0.5
    store.move(np.stack([T, T]))
    moved = store.get(wall_frame(1).id)
    assert moved is not None
    assert moved.frame.T_world_camera[0, 3] == 0.5
    assert store.get(wall_frame(9).id) is None


def test_a_frame_that_comes_again_replaces_its_keyframe() -> None:
    store, rasterizer, settings = stored(KeyframeSettings(every=1), 3), CpuRasterizer(threads=1), KeyframeSettings()
    again = wall_frame(1, shift_m=0.3)
    store.add(window_view(Keyframe(again, middle_relevance(again)), rasterizer, settings))
    assert [keyframe.frame.index for keyframe in store.buffer] == [0, 2, 1]
    assert [view.keyframe.frame.index for view in store.window] == [0, 2, 1]
    assert store.buffer[-1].frame.T_world_camera[0, 3] == 0.3


def test_tiles_cover_the_region_and_its_margin() -> None:
    region = np.zeros((40, 64), np.bool_)
    region[0:12, 20:28] = True
    expected = np.zeros((3, 4), np.bool_)
    expected[0:2, 0:3] = True
    np.testing.assert_array_equal(tiles_touching(region, 5), expected)
    assert not tiles_touching(np.zeros((40, 64), np.bool_), 5).any()


def test_shows_roi_is_true_only_with_relevant_pixels() -> None:
    frame, rasterizer = wall_frame(), CpuRasterizer(threads=1)
    assert window_view(Keyframe(frame, middle_relevance(frame)), rasterizer, KeyframeSettings()).shows_roi
    assert not window_view(Keyframe(frame, RelevanceMap.empty(48, 64)), rasterizer, KeyframeSettings()).shows_roi
