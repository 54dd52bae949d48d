"""Frames to train on: a keyframe with its relevance, and its view prepared for the rasterizer (Sec. III-D.2, MVO)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.depth_edges import without_depth_edges
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_counts, int_array, select_prefix
from gausslite.mapping.checkpoint import frame_from_state, frame_state, relevance_from_state, relevance_state
from gausslite.mapping.settings import KeyframeSettings
from gausslite.render.rasterizer import TILE_PX, Rasterizer, Subset, TrainingView

_SSIM_WINDOW_PX = 11
_DEPTH_STEP_PX = 8


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame with its per-pixel relevance to the task (Sec. III-B).

    recorded: the frame with the source's pose and colours, if `frame` has refined ones; otherwise None.
    evaluated: False until the relevance to the present task is known; `relevance` is empty until then.
    """

    frame: Frame
    relevance: RelevanceMap
    recorded: Frame | None = None
    evaluated: bool = True

    @property
    def as_recorded(self) -> Frame:
        """The frame with the source's pose and colours."""
        return self.frame if self.recorded is None else self.recorded

    def state(self) -> State:
        """Return the keyframe as named arrays."""
        recorded = {} if self.recorded is None else frame_state(self.recorded)
        return {
            **add_prefix("frame", frame_state(self.frame)),
            **add_prefix("relevance", relevance_state(self.relevance)),
            **add_prefix("recorded", recorded),
            "evaluated": int_array(self.evaluated),
        }

    @classmethod
    def from_state(cls, state: State) -> Keyframe:
        """Return the keyframe that `state` described. Raises MapFileError, InvalidInputError."""
        frame = frame_from_state(select_prefix(state, "frame"))
        recorded = select_prefix(state, "recorded")
        relevance = relevance_from_state(select_prefix(state, "relevance"), frame)
        [evaluated] = get_counts(state, "evaluated", 1)
        return cls(frame, relevance, frame_from_state(recorded) if recorded else None, bool(evaluated))


def is_same_frame(a: Keyframe, b: Keyframe) -> bool:
    """True if both keyframes come from the same recorded frame."""
    return a.as_recorded is b.as_recorded


def motion_blur_px(frame: Frame) -> float:
    """Return the standard deviation of a point's image during the exposure, at the frame's median depth; 0 at rest."""
    motion = frame.motion
    if motion is None or motion.exposure_s == 0.0:
        return 0.0
    depths_m = frame.depth_m[::_DEPTH_STEP_PX, ::_DEPTH_STEP_PX]
    distance_m = float(np.median(depths_m[depths_m > 0])) if (depths_m > 0).any() else np.inf
    rotation_rad_s, speed_m_s = (
        float(np.linalg.norm(v)) for v in (motion.twist.angular_rad_s, motion.twist.linear_m_s)
    )
    return frame.camera.angle_px(rotation_rad_s + speed_m_s / distance_m) * motion.exposure_s / 12**0.5


@dataclass(frozen=True, slots=True, eq=False)
class WindowView:
    """A keyframe prepared for training. roi: the 16x16 tiles that touch the ROI or its margin."""

    keyframe: Keyframe
    training_view: TrainingView
    T_camera_world: Float64[ndarray, "4 4"]
    roi: Subset

    @property
    def shows_roi(self) -> bool:
        """True if a pixel belongs to the ROI."""
        return self.roi.tiles is not None and bool(self.roi.tiles.any())


def window_view(keyframe: Keyframe, rasterizer: Rasterizer, settings: KeyframeSettings) -> WindowView:
    """Prepare a keyframe for training. The margin gives the SSIM window its neighbours at the ROI's border."""
    frame, relevance = keyframe.frame, keyframe.relevance
    tiles, pixel_weights = tiles_touching(relevance.roi, settings.roi_margin_px), relevance.pixel_weights
    if settings.roi_context_weight > 0:
        context = np.float32(settings.roi_context_weight) * _pixels_inside(tiles, pixel_weights.shape)
        pixel_weights = np.maximum(pixel_weights, context)
    depth_m = without_depth_edges(frame.depth_m, settings.depth_edge_px)
    return WindowView(
        keyframe=keyframe,
        training_view=rasterizer.prepare_view(frame.rgb, depth_m, frame.camera, pixel_weights, frame.motion),
        T_camera_world=inverse(frame.T_world_camera),
        roi=Subset(tiles),
    )


def tiles_touching(mask: Bool[ndarray, "h w"], margin_px: int) -> Bool[ndarray, "th tw"]:
    """Return the 16x16 tiles that touch the mask dilated by margin_px."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    dilated = cv2.dilate(mask.view(np.uint8), kernel)
    height, width = mask.shape
    padded = np.pad(dilated, ((0, -height % TILE_PX), (0, -width % TILE_PX)))
    by_rows = padded.reshape(-1, TILE_PX, padded.shape[1]).max(axis=1)
    tiles: Bool[ndarray, "th tw"] = by_rows.reshape(len(by_rows), -1, TILE_PX).any(axis=2)
    return tiles


def _pixels_inside(tiles: Bool[ndarray, "th tw"], shape: tuple[int, ...]) -> Bool[ndarray, "h w"]:
    """Return the pixels whose whole SSIM window lies in these tiles; outside them nothing is rendered."""
    rendered = np.repeat(np.repeat(tiles, TILE_PX, axis=0), TILE_PX, axis=1)[: shape[0], : shape[1]]
    return cv2.erode(rendered.astype(np.uint8), np.ones((_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), np.uint8)) > 0
