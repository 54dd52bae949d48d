"""A step moves the rows and pixels that it may, counts those that it moved, and refuses tables that do not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splat_scenes import Picture, relative_error, scene_named
from step_training import ADAM, LOSS, gradient_seen, picture_for, tables, train

from gausslite.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import (
    UPDATE_COUNT,
    Rasterizer,
    UpdateCounter,
)


def test_rows_out_of_sight_are_untouched(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("outside the view")
    done = train(rasterizer, scene, picture_for(scene, oracle), seasoned=True)
    hidden = np.setdiff1d(np.arange(len(scene.rows)), done.report.visible)
    assert len(hidden) > 10
    for after, before in zip((done.rows, done.first_moment, done.second_moment), done.before, strict=True):
        np.testing.assert_array_equal(after[hidden], before[hidden])


def test_frozen_rows_are_untouched_and_the_others_move_as_ever(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = picture_for(scene, oracle)
    trainable = np.random.default_rng(5).random(len(scene.rows)) < 0.5
    free = train(rasterizer, scene, picture, seasoned=True)
    held = train(rasterizer, scene, picture, trainable=trainable, seasoned=True)
    np.testing.assert_array_equal(held.report.visible, free.report.visible)
    for after, before, unheld in zip(
        (held.rows, held.first_moment, held.second_moment),
        held.before,
        (free.rows, free.first_moment, free.second_moment),
        strict=True,
    ):
        np.testing.assert_array_equal(after[~trainable], before[~trainable])
        assert relative_error(after[trainable], unheld[trainable]) < 1e-4


def test_a_tally_counts_the_rows_that_moved_and_no_others(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    lent, rng = tables(scene, seasoned=False), np.random.default_rng(6)
    trainable, among = rng.random((2, len(scene.rows))) < 0.5
    everywhere, some = (UpdateCounter(np.full(len(scene.rows), 7, np.uint32), choice) for choice in (None, among))
    with rasterizer.bind_tables(*lent):
        for step in range(10):
            rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM, trainable=trainable, update_counter=everywhere)
            if step < 3:
                rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM, update_counter=some)
    trained = lent[0][:, UPDATE_COUNT]
    np.testing.assert_array_equal(some.counts[~among], 7)
    assert set(some.counts[among]) == {7, 10}
    np.testing.assert_array_equal(everywhere.counts[~trainable], 7)
    np.testing.assert_array_equal((everywhere.counts - 7 + 3 * (trained > 0))[trainable], trained[trainable])


def test_tables_are_lent_one_at_a_time(rasterizer: Rasterizer) -> None:
    scene = scene_named("medium splats")
    lent, others = tables(scene, seasoned=False), tables(scene, seasoned=False)
    with (
        rasterizer.bind_tables(*lent),
        pytest.raises(InvalidInputError, match="no bound tables"),
        rasterizer.bind_tables(*others),
    ):
        pass
    with rasterizer.bind_tables(*others):
        pass


def test_a_tally_of_another_length_or_that_may_not_be_written_is_refused(
    rasterizer: Rasterizer, oracle: Rasterizer
) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    sealed = np.zeros(len(scene.rows), np.uint32)
    sealed.flags.writeable = False
    for counts in (np.zeros(len(scene.rows) - 1, np.uint32), sealed):
        with pytest.raises(ShapeError, match="update_counter counts"):
            rasterizer.step(
                *tables(scene, seasoned=False), view, scene.T_camera_world, LOSS, ADAM, update_counter=UpdateCounter(counts)
            )


def test_pixels_of_weight_zero_do_not_matter_to_a_masked_step(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = picture_for(scene, oracle)
    other_rgb, other_depth_m = 255 - picture.rgb, picture.depth_m + np.float32(0.5)
    unseen = picture.weight == 0
    changed = Picture(
        np.where(unseen[..., None], other_rgb, picture.rgb),
        np.where(unseen, other_depth_m, picture.depth_m),
        picture.weight,
    )
    loss = replace(LOSS, ssim=0.0)
    first = train(rasterizer, scene, picture, loss=loss, masked=True)
    second = train(rasterizer, scene, changed, loss=loss, masked=True)
    assert first.report.loss == pytest.approx(second.report.loss, rel=1e-6)
    assert relative_error(second.first_moment, first.first_moment) < 1e-5


def test_an_empty_mask_has_no_loss_and_no_gradient(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = replace(picture_for(scene, oracle), weight=np.zeros(scene.size, np.float32))
    done = train(rasterizer, scene, picture, masked=True)
    assert done.report.loss == 0.0
    assert np.abs(gradient_seen(done)).max() < 1e-9
    assert np.isfinite(done.rows).all()


def test_moments_of_another_length_are_refused(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    rows, first, second = tables(scene, seasoned=False)
    with pytest.raises((ShapeError, TypeError)):
        rasterizer.step(rows, first[:-1], second, view, scene.T_camera_world, LOSS, ADAM)


def test_a_view_of_another_size_than_its_camera_is_refused(rasterizer: Rasterizer) -> None:
    camera = scene_named("odd size").camera
    with pytest.raises(ShapeError, match="rgb"):
        rasterizer.prepare_view(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), camera)
