"""A step changes only visible rows, counts their updates, and rejects invalid tables."""

from dataclasses import replace

import numpy as np
import pytest
from splat_scenes import TargetImage, named_scene, relative_error
from step_training import ADAM, LOSS, applied_gradient, tables, target_for, train

from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import UPDATE_COUNT, Rasterizer, UpdateCounter


def test_invisible_rows_are_unchanged(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("outside the view")
    result = train(rasterizer, scene, target_for(scene, oracle), with_history=True)
    hidden = np.setdiff1d(np.arange(len(scene.rows)), result.report.visible)
    assert len(hidden) > 10
    for after, before in zip((result.rows, result.first_moment, result.second_moment), result.before, strict=True):
        np.testing.assert_array_equal(after[hidden], before[hidden])


def test_update_counter_counts_changed_rows(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    view = target_for(scene, oracle).view(rasterizer, scene)
    bound, rng = tables(scene, with_history=False), np.random.default_rng(6)
    mask = rng.random(len(scene.rows)) < 0.5
    all_counter, masked_counter = (
        UpdateCounter(np.full(len(scene.rows), 7, np.uint32), selection) for selection in (None, mask)
    )
    with rasterizer.bind_tables(*bound):
        for step in range(10):
            rasterizer.step(*bound, view, scene.T_camera_world, LOSS, ADAM, update_counter=all_counter)
            if step < 3:
                rasterizer.step(*bound, view, scene.T_camera_world, LOSS, ADAM, update_counter=masked_counter)
    trained = bound[0][:, UPDATE_COUNT]
    np.testing.assert_array_equal(masked_counter.counts[~mask], 7)
    assert set(masked_counter.counts[mask]) == {7, 10}
    np.testing.assert_array_equal(all_counter.counts - 7 + 3 * (trained > 0), trained)


def test_second_binding_is_rejected(rasterizer: Rasterizer) -> None:
    scene = named_scene("medium splats")
    bound, others = tables(scene, with_history=False), tables(scene, with_history=False)
    with (
        rasterizer.bind_tables(*bound),
        pytest.raises(InvalidInputError, match="no bound tables"),
        rasterizer.bind_tables(*others),
    ):
        pass
    with rasterizer.bind_tables(*others):
        pass


def test_update_counter_of_wrong_length_or_read_only_is_rejected(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    view = target_for(scene, oracle).view(rasterizer, scene)
    read_only = np.zeros(len(scene.rows), np.uint32)
    read_only.flags.writeable = False
    for counts in (np.zeros(len(scene.rows) - 1, np.uint32), read_only):
        counter, arrays = UpdateCounter(counts), tables(scene, with_history=False)
        with pytest.raises(ShapeError, match="update_counter counts"):
            rasterizer.step(*arrays, view, scene.T_camera_world, LOSS, ADAM, update_counter=counter)


def test_masked_step_ignores_pixels_of_weight_zero(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    target = target_for(scene, oracle)
    other_rgb, other_depth_m = 255 - target.rgb, target.depth_m + np.float32(0.5)
    unweighted = target.pixel_weights == 0
    changed = TargetImage(
        np.where(unweighted[..., None], other_rgb, target.rgb),
        np.where(unweighted, other_depth_m, target.depth_m),
        target.pixel_weights,
    )
    loss = replace(LOSS, ssim=0.0)
    first = train(rasterizer, scene, target, loss=loss, masked=True)
    second = train(rasterizer, scene, changed, loss=loss, masked=True)
    assert first.report.loss == pytest.approx(second.report.loss, rel=1e-6)
    assert relative_error(second.first_moment, first.first_moment) < 1e-5


def test_empty_mask_gives_zero_loss_and_gradient(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    target = replace(target_for(scene, oracle), pixel_weights=np.zeros(scene.size, np.float32))
    result = train(rasterizer, scene, target, masked=True)
    assert result.report.loss == 0.0
    assert np.abs(applied_gradient(result)).max() < 1e-9
    assert np.isfinite(result.rows).all()


def test_moments_of_wrong_length_are_rejected(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    view = target_for(scene, oracle).view(rasterizer, scene)
    rows, first, second = tables(scene, with_history=False)
    with pytest.raises((ShapeError, TypeError)):
        rasterizer.step(rows, first[:-1], second, view, scene.T_camera_world, LOSS, ADAM)


def test_view_of_wrong_size_is_rejected(rasterizer: Rasterizer) -> None:
    camera = named_scene("odd size").camera
    with pytest.raises(ShapeError, match="rgb"):
        rasterizer.prepare_view(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), camera)
