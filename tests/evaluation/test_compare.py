"""Scores of maps on held-out views."""

from dataclasses import replace

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import BallRegion
from gausslite.mission.evaluation import TrainingFit
from gausslite.render.map_viewer import MapViewer
from gausslite_evaluation.compare import MAX_PSNR_DB, average, evaluate, score_training_views, score_view
from gausslite_evaluation.metrics import psnr
from gausslite_evaluation.views import HeldOutView

pytest.importorskip("torch", reason="the reference rasterizer needs torch, which is not installed")

from torch_oracle.rasterizer import ReferenceRasterizer

from gausslite.render.rasterizer import Rendering

CAMERA = Camera(40.0, 40.0, 20.0, 16.0, 40, 32)


def wall(n: int = 300, seed: int = 0) -> Gaussians:
    """Opaque splats that cover the view at about two metres."""
    rng = np.random.default_rng(seed)
    means_m = np.stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-1, 1, n), rng.uniform(1.9, 2.1, n)], axis=1)
    return plain_gaussians(means_m, scales_m=0.15, rgb=rng.random((n, 3), np.float32))


def frame_of(gaussians: Gaussians, x_m: float = 0.0) -> Frame:
    """Return the frame that a perfect camera at (x, 0, 0) would record of the map."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x_m
    rendering = MapViewer(gaussians, ReferenceRasterizer()).render(CAMERA, T_world_camera)
    rgb = np.rint(rendering.rgb * 255).astype(np.uint8)
    return Frame(int(100 * x_m), 0, rgb, rendering.expected_depth_m(), CAMERA, T_world_camera)


def view_with(frame: Frame, roi_pixels: int) -> HeldOutView:
    roi = np.zeros(CAMERA.height_px * CAMERA.width_px, np.bool_)
    roi[:roi_pixels] = True
    return HeldOutView(frame, roi.reshape(frame.depth_m.shape))


def test_a_perfect_map_scores_up_to_the_rounding_to_bytes() -> None:
    gaussians = wall()
    views = [view_with(frame_of(gaussians, x), 200) for x in (0.0, 0.1)]
    scores = evaluate(gaussians, views, ReferenceRasterizer())
    assert scores.full_psnr > 55
    assert scores.roi_psnr is not None
    assert scores.roi_psnr > 55
    assert scores.full_ssim == pytest.approx(1.0, abs=1e-3)
    assert scores.roi_depth_l1_m == pytest.approx(0.0, abs=1e-5)
    assert scores.roi_covered == pytest.approx(1.0)
    assert (scores.n_views, scores.n_roi_views, scores.roi_pixels) == (2, 2, 400)


def test_a_perfect_image_has_a_finite_psnr() -> None:
    frame = frame_of(wall())
    rendering = Rendering(frame.rgb / np.float32(255.0), frame.depth_m, np.ones_like(frame.depth_m), None)
    scores = average([score_view(rendering, view_with(frame, 100)), score_view(rendering, view_with(frame, 0))])
    assert scores.roi_psnr == scores.full_psnr == MAX_PSNR_DB
    left_out = view_with(frame, 400).roi  # a training view's moving thing, which no map shows
    seen = replace(frame, rgb=np.where(left_out[..., None], 255 - frame.rgb, frame.rgb)).without(left_out)
    assert score_training_views(lambda _: rendering, [(seen, ~left_out)]) == TrainingFit(MAX_PSNR_DB, MAX_PSNR_DB, 1)


def test_another_map_scores_worse() -> None:
    views = [view_with(frame_of(wall()), 200)]
    scores = evaluate(wall(seed=1), views, ReferenceRasterizer())
    assert scores.full_psnr < 20
    assert scores.full_ssim < 0.6


def test_an_empty_map_is_black_and_covers_nothing() -> None:
    frame = frame_of(wall())
    scores = evaluate(Gaussians.empty(), [view_with(frame, 100)], ReferenceRasterizer())
    assert scores.full_psnr == pytest.approx(psnr(np.zeros_like(frame.rgb), frame.rgb))
    assert scores.roi_covered == 0.0
    assert scores.roi_depth_l1_m is None


def test_coverage_is_the_share_of_measured_pixels_that_the_map_covers() -> None:
    whole = wall()
    half = whole.take(whole.means_m[:, 0] < 0.0)
    frame = frame_of(whole)
    on_the_right = frame.depth_m * (np.arange(CAMERA.width_px, dtype=np.float32) >= 10)
    view = HeldOutView(replace(frame, depth_m=on_the_right), np.ones(frame.depth_m.shape, np.bool_))
    scores = [evaluate(gaussians, [view], ReferenceRasterizer()) for gaussians in (whole, half)]
    assert scores[0].roi_covered == pytest.approx(1.0)
    rendering = MapViewer(half, ReferenceRasterizer()).render_frame(frame)
    assert scores[1].roi_covered == pytest.approx((rendering.alpha[:, 10:] > 0.5).mean()) == pytest.approx(0.5, abs=0.1)
    unmeasured = HeldOutView(replace(frame, depth_m=np.zeros_like(on_the_right)), view.roi)
    assert evaluate(whole, [unmeasured], ReferenceRasterizer()).roi_covered is None


@pytest.mark.slow
def test_a_view_with_few_roi_pixels_counts_for_the_whole_image_only() -> None:
    gaussians = wall()
    frame = frame_of(gaussians)
    viewer = MapViewer(gaussians, ReferenceRasterizer())
    rendering = viewer.render_frame(frame)
    seen, unseen = (score_view(rendering, view_with(frame, n)) for n in (64, 63))
    assert unseen.roi is None
    scores = average([seen, unseen])
    assert (scores.n_views, scores.n_roi_views, scores.roi_pixels) == (2, 1, 64)
    alone = average([unseen])
    assert alone.roi_psnr is alone.roi_ssim is alone.roi_depth_l1_m is None


def test_scores_are_means_over_views() -> None:
    gaussians = wall()
    frames = [frame_of(wall(seed=seed)) for seed in (1, 2)]
    viewer = MapViewer(gaussians, ReferenceRasterizer())
    each = [score_view(viewer.render_frame(frame), view_with(frame, 300)) for frame in frames]
    assert average(each).full_psnr == pytest.approx((each[0].full.psnr + each[1].full.psnr) / 2)


def test_regions_are_merged_into_one_mask() -> None:
    frame = frame_of(wall())
    left, right = BallRegion((-0.5, 0.0, 2.0), 0.3), BallRegion((0.5, 0.0, 2.0), 0.3)
    view = HeldOutView.of(frame, [left, right])
    np.testing.assert_array_equal(view.roi, left.mask(frame) | right.mask(frame))
    assert view.roi.any()


def test_no_views_are_refused() -> None:
    pytest.raises(InvalidInputError, evaluate, wall(), [], ReferenceRasterizer()).match("held-out views")
