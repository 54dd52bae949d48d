"""Small frames for the mapper's tests: a textured wall seen from a metre or two, with a region in the middle."""

from dataclasses import replace

import numpy as np

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.mapper import FrameView, GaussianMapper, MappedFrame
from gausslite.mapping.stages import CountedScheduler, StageScheduler
from gausslite.render.rasterizer import Rendering


def wall_frame(index: int = 0, size: tuple[int, int] = (64, 48), depth_m: float = 2.0, shift_m: float = 0.0) -> Frame:
    """The wall stands still at z = depth_m; shift_m moves the camera along x. size is (width, height)."""
    width, height = size
    camera = Camera(float(width), float(width), width / 2, height / 2, width, height)
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = shift_m
    x = (np.arange(width) + 0.5 - camera.cx_px) / camera.fx_px * depth_m + shift_m
    y = (np.arange(height) + 0.5 - camera.cy_px) / camera.fy_px * depth_m
    pattern = 0.5 + 0.25 * np.sin(6 * x)[None, :] + 0.25 * np.cos(5 * y)[:, None]
    rgb = (255 * np.stack([pattern, pattern**2, 1 - pattern], axis=-1)).astype(np.uint8)
    return Frame(index, index * 33_000_000, rgb, np.full((height, width), depth_m, np.float32), camera, T_world_camera)


def with_box(frame: Frame) -> Frame:
    """Return the frame with a box in its middle third, 40 cm before what is there: an object that a click finds."""
    height, width = frame.depth_m.shape
    depth_m = frame.depth_m.copy()
    depth_m[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] -= 0.4
    return replace(frame, depth_m=depth_m)


def middle_relevance(frame: Frame) -> RelevanceMap:
    """The middle third of the image belongs to target 0."""
    height, width = frame.depth_m.shape
    pixel_weights = np.zeros((height, width), np.float32)
    pixel_weights[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 1.0
    return RelevanceMap(pixel_weights, np.where(pixel_weights > 0, 0, -1).astype(np.int16))


def map_frame(
    mapper: GaussianMapper, frame: Frame, relevance: RelevanceMap | None = None, scheduler: StageScheduler | None = None
) -> MappedFrame:
    """Map a frame as it is, with things that move; without a relevance that of `middle_relevance`."""
    seen = middle_relevance(frame) if relevance is None else relevance
    return mapper.map_view(FrameView(frame), seen, scheduler or CountedScheduler())


def rendering_of(alpha: np.ndarray, depth_m: np.ndarray) -> Rendering:
    """A picture of a map with this alpha and, where it shows, this expected depth."""
    alpha = alpha.astype(np.float32)
    rgb = np.zeros((*alpha.shape, 3), np.float32)
    return Rendering(rgb, (alpha * depth_m).astype(np.float32), alpha, None)
