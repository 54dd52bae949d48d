"""Frames of a moving camera: seeds at the poses of their rows, training and rendering with motion, and their state."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame
from torch_oracle.rasterizer import ReferenceRasterizer

from gausslite.domain.camera import CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Twist
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.keyframes import frame_from_state, frame_state
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.seeding import Seeder, SeedingContext
from gausslite.mapping.settings import Components, MapperSettings, SeedingSettings
from gausslite.mapping.stages import CountedScheduler

_APPROACH = CameraMotion(Twist(np.array([0.0, 0.0, 2.0]), np.zeros(3)), readout_s=0.05)


def approaching_frame() -> Frame:
    """A wall at z = 2 whose rows are seen from nearer and nearer."""
    frame = wall_frame()
    shares = (np.arange(frame.camera.height_px) + 0.5) / frame.camera.height_px - 0.5
    depth_m = 2.0 - 2.0 * 0.05 * np.repeat(shares[:, None], frame.camera.width_px, axis=1)
    return replace(frame, depth_m=depth_m.astype(np.float32), motion=_APPROACH)


def test_seeds_lie_on_the_surface_that_each_row_sees() -> None:
    frame = approaching_frame()
    seeder = Seeder(SeedingSettings(), Components(mvo=False), np.random.default_rng(0))
    context = SeedingContext(1_000_000, None, np.zeros((0, 3), np.float32))
    moving = seeder.seed(frame, RelevanceMap.empty(48, 64), context).background
    np.testing.assert_allclose(moving.means_m[:, 2], 2.0, atol=1e-6)
    still = seeder.seed(replace(frame, motion=None), RelevanceMap.empty(48, 64), context).background
    assert np.ptp(still.means_m[:, 2]) > 0.08


def test_the_map_renders_what_the_moving_camera_sees() -> None:
    frame = approaching_frame()
    mapper = GaussianMapper(MapperSettings(max_gaussians=4000), ReferenceRasterizer(), seed=0)
    map_frame(mapper, frame)
    rendered = mapper.look(frame, CountedScheduler()).rendered
    assert rendered is not None
    seen = rendered.alpha > 0.8
    assert seen.mean() > 0.5
    error_m = (rendered.expected_depth_m() - frame.depth_m)[seen]
    assert np.median(np.abs(error_m)) < 0.01
    top_to_bottom = error_m[: len(error_m) // 4].mean() - error_m[-len(error_m) // 4 :].mean()
    assert abs(top_to_bottom) < 0.02


@pytest.mark.parametrize("motion", [None, CameraMotion(Twist(np.arange(3.0), -np.arange(3.0)), -0.02, 0.01)])
def test_a_frame_is_restored_with_its_motion(motion: CameraMotion | None) -> None:
    frame = replace(wall_frame(), motion=motion).without(wall_frame().rgb[..., 0] > 128)
    restored = frame_from_state(frame_state(frame))
    np.testing.assert_array_equal(restored.left_out, frame.left_out)
    if motion is None:
        assert restored.motion is None
        return
    assert restored.motion is not None
    np.testing.assert_array_equal(restored.motion.twist.linear_m_s, motion.twist.linear_m_s)
    np.testing.assert_array_equal(restored.motion.twist.angular_rad_s, motion.twist.angular_rad_s)
    assert (restored.motion.readout_s, restored.motion.exposure_s) == (-0.02, 0.01)
