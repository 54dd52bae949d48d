"""Pose and exposure fits recover known errors, and the prior limits them."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, middle_relevance, wall_frame

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.pose_estimation import RefinementSettings
from gausslite.mapping.poses import PoseTable
from gausslite.mapping.settings import ONLINE_RATES, KeyframeSettings, MapperSettings, OptimizationSettings
from gausslite.mapping.window_view import window_view
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite.render.rasterizer import Rendering
from gausslite_evaluation.metrics import psnr
from gausslite_evaluation.views import render_fitted
from gausslite_poses.exposure import AffineExposure, fit_exposure
from gausslite_poses.photometric import fit_pose
from gausslite_poses.refinement import ViewRefiner

SIZE = (96, 72)
LOOSE = PoseExposurePrior(translation_m=1.0, rotation_deg=20.0, gain=1.0, offset=1.0)


def rendering_like(frame: Frame) -> Rendering:
    """Return a rendering equal to this frame."""
    return Rendering(frame.rgb / np.float32(255.0), frame.depth_m, np.ones_like(frame.depth_m), None)


def displaced(frame: Frame, shift_m: float, turn_deg: float) -> Frame:
    """Return the frame with a wrong pose."""
    T_true_wrong = np.eye(4)
    angle = np.radians(turn_deg)
    T_true_wrong[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T_true_wrong[1, 3] = shift_m
    return replace(frame, T_world_camera=frame.T_world_camera @ T_true_wrong)


def test_fit_pose_recovers_a_known_displacement() -> None:
    true = wall_frame(size=SIZE)
    wrong = displaced(true, 0.03, 0.8)
    T_world_camera = fit_pose(rendering_like(true), inverse(true.T_world_camera), wrong, LOOSE)
    assert translation_m(T_world_camera, true.T_world_camera) < 0.003
    assert rotation_angle_deg(T_world_camera, true.T_world_camera) < 0.1


def test_a_tighter_prior_keeps_the_pose_closer_to_the_odometry() -> None:
    true = wall_frame(size=SIZE)
    wrong = displaced(true, 0.03, 0.0)
    deviations_m = [
        translation_m(
            fit_pose(rendering_like(true), inverse(true.T_world_camera), wrong, PoseExposurePrior(std_m, 0.2)),
            wrong.T_world_camera,
        )
        for std_m in (0.0, 0.002, 0.01, 0.1)
    ]
    assert deviations_m == sorted(deviations_m)
    assert deviations_m[0] < 1e-9


def test_a_larger_image_leaves_less_of_a_correction_undone() -> None:
    kept = []
    for scale in (1, 4):
        true = wall_frame(size=(96 * scale, 72 * scale))
        wrong = displaced(true, 0.005, 0.0)
        T_world_camera = fit_pose(rendering_like(true), inverse(true.T_world_camera), wrong, PoseExposurePrior(0.002))
        kept.append(translation_m(T_world_camera, wrong.T_world_camera) / 0.005)
    assert kept[0] < 0.4
    assert kept[1] > 0.6


def test_fit_exposure_recovers_a_known_exposure_and_inverts_it() -> None:
    frame = wall_frame(size=SIZE)
    exposure = AffineExposure(np.array([0.8, 0.9, 0.7]), np.array([0.05, 0.0, 0.1]))
    photograph = np.rint(exposure.to_photograph(rendering_like(frame).rgb) * 255).astype(np.uint8)
    found = fit_exposure(rendering_like(frame), replace(frame, rgb=photograph), LOOSE)
    np.testing.assert_allclose(found.gain, exposure.gain, atol=0.01)
    np.testing.assert_allclose(found.offset, exposure.offset, atol=0.01)
    assert np.abs(found.to_map(photograph).astype(int) - frame.rgb).max() <= 4


def mapped(prior: PoseExposurePrior, displacement_m: float = 0.0, decay_after_updates: float = 150.0) -> GaussianMapper:
    settings = MapperSettings(
        max_gaussians=2000,
        keyframes=KeyframeSettings(every=1),
        optimization=OptimizationSettings(adam=replace(ONLINE_RATES, decay_after_updates=decay_after_updates)),
        pose_prior=prior,
    )
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(4):
        frame = displaced(wall_frame(index, SIZE, shift_m=0.05 * index), displacement_m * (index % 2), 0.0)
        map_frame(mapper, frame)
    return mapper


def test_an_exact_prior_leaves_the_views_as_recorded() -> None:
    for keyframe in mapped(PoseExposurePrior()).store.kept:
        assert keyframe.recorded is None


def test_a_very_tight_prior_leaves_poses_and_colours_unchanged() -> None:
    keyframes = mapped(PoseExposurePrior(1e-9, 1e-9, 1e-9, 1e-9)).store.kept
    assert all(keyframe.recorded is not None for keyframe in keyframes[1:])
    for keyframe in keyframes[1:]:
        np.testing.assert_allclose(keyframe.frame.T_world_camera, keyframe.recorded.T_world_camera, atol=1e-9)
        assert (keyframe.frame.rgb == keyframe.recorded.rgb).all()


@pytest.mark.parametrize("prior", [PoseExposurePrior(), PoseExposurePrior(0.01, 0.5)])
def test_learning_rates_decay_with_exact_poses_too(prior: PoseExposurePrior) -> None:
    decaying, constant = (mapped(prior, decay_after_updates=updates) for updates in (1.0, math.inf))
    before = [mapper.gaussians().rgb for mapper in (decaying, constant)]
    frame = wall_frame(4, SIZE, shift_m=0.2)
    for mapper in (decaying, constant):
        map_frame(mapper, frame)
    moved = [
        float(np.abs(mapper.gaussians().rgb[: len(old)] - old).mean())
        for mapper, old in zip((decaying, constant), before, strict=True)
    ]
    assert moved[0] < 0.7 * moved[1]


def test_keyframes_with_contradicting_poses_converge() -> None:
    # on one flat wall a shift and a rotation look alike, so the prior fixes the rotation
    keyframes = mapped(PoseExposurePrior(0.05, 0.0), displacement_m=0.03).store.kept[1:]

    def errors_m(poses: list[np.ndarray]) -> list[float]:
        true = [wall_frame(k.frame.index, SIZE, shift_m=0.05 * k.frame.index).T_world_camera for k in keyframes]
        return [float((pose - T)[1, 3]) for pose, T in zip(poses, true, strict=True)]

    before = errors_m([k.recorded.T_world_camera for k in keyframes if k.recorded is not None])
    after = errors_m([k.frame.T_world_camera for k in keyframes])
    assert np.std(after) < 0.5 * np.std(before)


@pytest.mark.parametrize("pose_updates_per_frame", [0, 1, 2, 9])
def test_keyframes_are_refined_equally_often(pose_updates_per_frame: int) -> None:
    rasterizer, settings = CpuRasterizer(threads=1), KeyframeSettings()
    frames = [wall_frame(index, SIZE) for index in range(5)]
    keyframes = [Keyframe(frame, middle_relevance(frame), recorded=frame if frame.index else None) for frame in frames]
    window = [window_view(keyframe, rasterizer, settings) for keyframe in keyframes]
    refinement = RefinementSettings(LOOSE, pose_updates_per_frame, anchor_share=0.1)
    refiner = ViewRefiner(refinement, lambda camera, T_world_camera, motion: rendering_like(frames[0]), PoseTable())
    rounds = [list(refiner.next_keyframes(window)) for _ in range(4)]
    assert [len(turn) for turn in rounds] == [min(pose_updates_per_frame, 4)] * 4
    fitted = Counter(keyframe.frame.index for turn in rounds for keyframe in turn)
    assert fitted == Counter({frame.index: min(pose_updates_per_frame, 4) for frame in frames[1:]})


def test_a_keyframe_for_which_a_frame_has_no_time_is_refined_with_the_next_one() -> None:
    rasterizer, settings = CpuRasterizer(threads=1), KeyframeSettings()
    keyframes = [Keyframe(f, middle_relevance(f), recorded=f) for f in (wall_frame(i, SIZE) for i in range(3))]
    window = [window_view(keyframe, rasterizer, settings) for keyframe in keyframes]
    refiner = ViewRefiner(
        RefinementSettings(LOOSE, 2, anchor_share=0.1), lambda *_: rendering_like(keyframes[0].frame), PoseTable()
    )
    assert next(refiner.next_keyframes(window)) is next(refiner.next_keyframes(window))


def mean_drift_m(anchor_share: float) -> float:
    """Return the mean correction after 40 frames, on a map that lies 2 mm beside the last refined pose."""
    drift_m = 0.0

    def render(_camera: object, T_world_camera: np.ndarray, _motion: object) -> Rendering:
        shown = wall_frame(size=(96, 72), shift_m=float(T_world_camera[0, 3]) - drift_m)
        return Rendering(shown.rgb / np.float32(255.0), shown.depth_m, np.ones_like(shown.depth_m), None)

    poses = PoseTable()
    refiner = ViewRefiner(RefinementSettings(PoseExposurePrior(1.0, 0.01), 0, anchor_share), render, poses)
    for index in range(40):
        frame = replace(wall_frame(index, (96, 72)), T_world_camera=np.eye(4))
        poses.add(frame, 0)
        drift_m = float(refiner.refine(frame).T_world_camera[0, 3]) + 0.002
    return float(poses.mean_correction[0])


def test_an_anchored_map_stays_near_the_odometry() -> None:
    # without an anchor the drift grows by 2 mm a frame; a share of 0.1 ends it at ten times that
    assert mean_drift_m(0.0) > 0.035
    assert mean_drift_m(0.1) < 0.021


@pytest.mark.parametrize("shift_m", [0.0, 0.02, 0.5])
def test_fitting_a_view_never_lowers_its_psnr(shift_m: float) -> None:
    viewer = MapViewer(mapped(PoseExposurePrior()).gaussians(), CpuRasterizer(threads=1))
    frame = displaced(wall_frame(9, SIZE, shift_m=0.03), shift_m, 0.0)
    raw, fitted = viewer.render_frame(frame), render_fitted(viewer, frame)
    assert psnr(fitted.rgb, frame.rgb) >= psnr(raw.rgb, frame.rgb)


@pytest.mark.parametrize("text", ["", "1", "0.1,0.2,0.3", "a,b", "-1,0", "nan,0", "0.1,inf", "1e300,0", "0,0,0,1e200"])
def test_an_invalid_prior_is_rejected(text: str) -> None:
    pytest.raises(InvalidInputError, PoseExposurePrior.parse, text).match("pose prior")
