"""A view's fitted pose and colour: found again where they are known, held fast where they are trusted."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import middle_relevance, wall_frame

from gausslite.calibration.exposure import AffineExposure, fit_exposure
from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.calibration.pose_fit import fit_pose
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, translation_m
from gausslite.errors import InvalidInputError
from gausslite.evaluation.fitted import render_fitted
from gausslite.evaluation.metrics import psnr
from gausslite.evaluation.views import MapViewer
from gausslite.mapping.keyframes import Keyframe, window_view
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import KeyframeSettings, MapperSettings, OptimizationSettings
from gausslite.mapping.view_refinement import ViewRefiner
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import Rendering

SIZE = (96, 72)
LOOSE = PoseExposurePrior(translation_m=1.0, rotation_deg=20.0, gain=1.0, offset=1.0)


def picture_of(frame: Frame) -> Rendering:
    """A map that draws exactly this frame."""
    return Rendering(frame.rgb / np.float32(255.0), frame.depth_m, np.ones_like(frame.depth_m), None)


def displaced(frame: Frame, shift_m: float, turn_deg: float) -> Frame:
    """The frame with a pose that was told wrongly."""
    T_true_told = np.eye(4)
    angle = np.radians(turn_deg)
    T_true_told[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T_true_told[1, 3] = shift_m
    return replace(frame, T_world_camera=frame.T_world_camera @ T_true_told)


def test_a_known_displacement_is_found_again() -> None:
    true = wall_frame(size=SIZE)
    told = displaced(true, 0.03, 0.8)
    T_world_camera = fit_pose(picture_of(true), inverse(true.T_world_camera), told, LOOSE)
    assert translation_m(T_world_camera, true.T_world_camera) < 0.003
    assert rotation_angle_deg(T_world_camera, true.T_world_camera) < 0.1


def test_the_tighter_the_prior_the_nearer_the_pose_stays_to_what_was_said() -> None:
    true = wall_frame(size=SIZE)
    told = displaced(true, 0.03, 0.0)
    strayed = [
        translation_m(
            fit_pose(picture_of(true), inverse(true.T_world_camera), told, PoseExposurePrior(said_m, 0.2)),
            told.T_world_camera,
        )
        for said_m in (0.0, 0.002, 0.01, 0.1)
    ]
    assert strayed == sorted(strayed)
    assert strayed[0] < 1e-9


def test_known_colours_are_found_again_and_undone() -> None:
    frame = wall_frame(size=SIZE)
    colour = AffineExposure(np.array([0.8, 0.9, 0.7]), np.array([0.05, 0.0, 0.1]))
    photograph = np.rint(colour.to_photograph(picture_of(frame).rgb) * 255).astype(np.uint8)
    found = fit_exposure(picture_of(frame), replace(frame, rgb=photograph), LOOSE)
    np.testing.assert_allclose(found.gain, colour.gain, atol=0.01)
    np.testing.assert_allclose(found.offset, colour.offset, atol=0.01)
    assert np.abs(found.to_map(photograph).astype(int) - frame.rgb).max() <= 4


def mapped(prior: PoseExposurePrior, tell: float = 0.0, decay_after_updates: float = 150.0) -> GaussianMapper:
    settings = MapperSettings(
        max_gaussians=2000,
        keyframes=KeyframeSettings(every=1),
        optimization=OptimizationSettings(decay_after_updates=decay_after_updates),
        pose_prior=prior,
    )
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(4):
        frame = displaced(wall_frame(index, SIZE, shift_m=0.05 * index), tell * (index % 2), 0.0)
        mapper.map_frame(frame, middle_relevance(frame))
    return mapper


def test_trusted_views_are_not_touched() -> None:
    for keyframe in mapped(PoseExposurePrior()).keyframes():
        assert keyframe.recorded is None


def test_a_prior_that_is_all_but_sure_makes_all_but_the_same_map() -> None:
    sure = mapped(PoseExposurePrior(1e-9, 1e-9, 1e-9, 1e-9)).keyframes()
    assert all(keyframe.recorded is not None for keyframe in sure[1:])
    for keyframe in sure[1:]:
        np.testing.assert_allclose(keyframe.frame.T_world_camera, keyframe.recorded.T_world_camera, atol=1e-9)
        assert (keyframe.frame.rgb == keyframe.recorded.rgb).all()


@pytest.mark.parametrize(("prior", "slows"), [(PoseExposurePrior(), False), (PoseExposurePrior(0.01, 0.5), True)])
def test_gaussians_settle_where_views_may_be_wrong(prior: PoseExposurePrior, slows: bool) -> None:
    settling, restless = (mapped(prior, decay_after_updates=updates) for updates in (1.0, math.inf))
    before = [mapper.gaussians().rgb for mapper in (settling, restless)]
    frame = wall_frame(4, SIZE, shift_m=0.2)
    for mapper in (settling, restless):
        mapper.map_frame(frame, middle_relevance(frame))
    moved = [
        float(np.abs(mapper.gaussians().rgb[: len(old)] - old).mean())
        for mapper, old in zip((settling, restless), before, strict=True)
    ]
    assert moved[0] < 0.7 * moved[1] if slows else moved[0] == moved[1]


def test_keyframes_told_in_contradiction_come_to_agree() -> None:
    # on one flat wall a shift and a turn look alike, so turns are trusted
    keyframes = mapped(PoseExposurePrior(0.05, 0.0), tell=0.03).keyframes()[1:]

    def errors_m(poses: list[np.ndarray]) -> list[float]:
        true = [wall_frame(k.frame.index, SIZE, shift_m=0.05 * k.frame.index).T_world_camera for k in keyframes]
        return [float((pose - T)[1, 3]) for pose, T in zip(poses, true, strict=True)]

    before = errors_m([k.recorded.T_world_camera for k in keyframes if k.recorded is not None])
    after = errors_m([k.frame.T_world_camera for k in keyframes])
    assert np.std(after) < 0.5 * np.std(before)


@pytest.mark.parametrize("pose_updates_per_frame", [0, 1, 2, 9])
def test_keyframes_that_may_change_are_fitted_again_equally_often(pose_updates_per_frame: int) -> None:
    rasterizer, settings = CpuRasterizer(threads=1), KeyframeSettings()
    frames = [wall_frame(index, SIZE) for index in range(5)]
    keyframes = [Keyframe(frame, middle_relevance(frame), recorded=frame if frame.index else None) for frame in frames]
    window = [window_view(keyframe, rasterizer, settings) for keyframe in keyframes]
    refiner = ViewRefiner(LOOSE, lambda camera, T_world_camera: picture_of(frames[0]), pose_updates_per_frame)
    turns = [refiner.next_turns(window) for _ in range(4)]
    assert [len(turn) for turn in turns] == [min(pose_updates_per_frame, 4)] * 4
    fitted = Counter(view.keyframe.frame.index for turn in turns for view in turn)
    assert fitted == Counter({frame.index: min(pose_updates_per_frame, 4) for frame in frames[1:]})


@pytest.mark.parametrize("shift_m", [0.0, 0.02, 0.5])
def test_fitting_a_view_never_lowers_its_whole_score(shift_m: float) -> None:
    viewer = MapViewer(mapped(PoseExposurePrior()).gaussians(), CpuRasterizer(threads=1))
    frame = displaced(wall_frame(9, SIZE, shift_m=0.03), shift_m, 0.0)
    raw, fitted = viewer.render_frame(frame), render_fitted(viewer, frame)
    assert psnr(fitted.rgb, frame.rgb) >= psnr(raw.rgb, frame.rgb)


@pytest.mark.parametrize("text", ["", "1", "0.1,0.2,0.3", "a,b", "-1,0", "nan,0", "0.1,inf", "1e300,0", "0,0,0,1e200"])
def test_an_error_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(InvalidInputError, match="view"):
        PoseExposurePrior.parse(text)
