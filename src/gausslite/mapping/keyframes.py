"""Keyframes with their relevance (Sec. III-D.2, MVO): the window to train on, and the buffer for joint refinement."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame, FrameId, without_depth_edges
from gausslite.domain.pose import Twist, inverse, orthonormal
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, get_floats, int_array, select_prefix
from gausslite.mapping.moving import without_pixels
from gausslite.mapping.settings import KeyframeSettings
from gausslite.render.rasterizer import DILATION_PX2, TILE_PX, Rasterizer, Subset, TrainingView

_ROI_MARGIN_PX = 5
"""Margin around the ROI within which tiles are rendered in the active phase: SSIM's window needs it."""
_SSIM_WINDOW_PX = 11
_DEPTH_STEP_PX = 8
_ALL_MEASURED = 0.999
_HALF_SIZE_DILATION_PX2 = (DILATION_PX2 + 0.25) / 4.0
"""Splats look as in the full image averaged over 2x2 pixels, which adds 1/4 px² to their variance."""


def frame_state(frame: Frame) -> dict[str, NDArray[Any]]:
    """Return a frame with its camera and pose as named arrays."""
    camera = frame.camera
    return {
        "stamp": int_array(frame.index, frame.capture_time_ns),
        "rgb": frame.rgb,
        "depth_m": frame.depth_m,
        "camera": np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
        "T_world_camera": frame.T_world_camera,
        **add_prefix("motion", _motion_state(frame.motion)),
    }


def frame_from_state(state: State) -> Frame:
    """Return a copy of the frame that `frame_state` described. Raises MapFileError, InvalidInputError."""
    index, capture_time_ns = (int(value) for value in get_array(state, "stamp", (2,), np.int64))
    depth_m = get_array(state, "depth_m", (None, None), np.float32).copy()
    fx_px, fy_px, cx_px, cy_px = get_floats(state, "camera", 4)
    camera = Camera(fx_px, fy_px, cx_px, cy_px, depth_m.shape[1], depth_m.shape[0])
    rgb = get_array(state, "rgb", (*depth_m.shape, 3), np.uint8).copy()
    T_world_camera = get_array(state, "T_world_camera", (4, 4), np.float64).copy()
    motion = _motion_from_state(select_prefix(state, "motion"))
    return Frame(
        index=index,
        capture_time_ns=capture_time_ns,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_world_camera=T_world_camera,
        motion=motion,
    )


def _motion_state(motion: CameraMotion | None) -> dict[str, NDArray[Any]]:
    if motion is None:
        return {}
    return {
        "linear_m_s": motion.twist.linear_m_s,
        "angular_rad_s": motion.twist.angular_rad_s,
        "times_s": np.array([motion.readout_s, motion.exposure_s]),
    }


def _motion_from_state(state: State) -> CameraMotion | None:
    if not state:
        return None
    linear_m_s, angular_rad_s = (np.array(get_floats(state, name, 3)) for name in ("linear_m_s", "angular_rad_s"))
    return CameraMotion(Twist(linear_m_s, angular_rad_s), *get_floats(state, "times_s", 2))


def relevance_state(relevance: RelevanceMap) -> dict[str, NDArray[Any]]:
    """Return a relevance map as named arrays."""
    return {
        "pixel_weights": relevance.pixel_weights,
        "target": relevance.target,
        "known_objects": int_array(relevance.known_objects),
    }


def relevance_from_state(state: State, frame: Frame) -> RelevanceMap:
    """Return the relevance map of this frame. Raises MapFileError, ShapeError."""
    pixel_weights = get_array(state, "pixel_weights", frame.depth_m.shape, np.float32).copy()
    if not ((pixel_weights >= 0) & (pixel_weights <= 1)).all():
        raise MapFileError("state pixel_weights: expected values in [0, 1], got others")
    (known_objects,) = get_counts(state, "known_objects", 1)
    return RelevanceMap(pixel_weights, get_array(state, "target", frame.depth_m.shape, np.int16).copy(), known_objects)


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame with its per-pixel relevance to the task (Sec. III-B)."""

    frame: Frame  # with the pose and the exposure as refined
    relevance: RelevanceMap
    recorded: Frame | None = None  # with the source's pose and colours, if `frame` has refined ones
    evaluated: bool = True  # False until the relevance to the present task is known; `relevance` is empty until then
    anchor: int = 0  # number of the keyframe that it follows when poses are corrected; its own, if it is one
    hidden: Bool[ndarray, "h w"] | None = None  # pixels that showed what has moved since; None if there are none

    def with_relevance(self, relevance: RelevanceMap) -> Keyframe:
        """Return the keyframe evaluated with this relevance; what has moved since is not relevant."""
        shown = relevance if self.hidden is None else relevance.without(self.hidden)
        return replace(self, relevance=shown, evaluated=True)

    def hide(self, pixels: Bool[ndarray, "h w"], rendered_rgb: Float32[ndarray, "h w 3"]) -> Keyframe:
        """Return the keyframe with these pixels out of training; rendered_rgb: the map from its pose."""
        recorded = None if self.recorded is None else without_pixels(self.recorded, pixels, rendered_rgb)
        return replace(
            self,
            frame=without_pixels(self.frame, pixels, rendered_rgb),
            recorded=recorded,
            relevance=self.relevance.without(pixels),
            hidden=pixels if self.hidden is None else self.hidden | pixels,
        )

    @property
    def as_recorded(self) -> Frame:
        """The frame with the source's pose and colours."""
        return self.frame if self.recorded is None else self.recorded

    def moved(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> Keyframe:
        """Return the keyframe moved with its anchor, given the motions by keyframe number.

        Its next refinement starts from the corrected pose, which replaces the odometry's.
        """
        T_world_camera = orthonormal(T_corrected_earlier[self.anchor] @ self.frame.T_world_camera)
        recorded = None if self.recorded is None else replace(self.recorded, T_world_camera=T_world_camera)
        return replace(self, frame=replace(self.frame, T_world_camera=T_world_camera), recorded=recorded)

    def state(self) -> State:
        """Return the keyframe as named arrays."""
        recorded = {} if self.recorded is None else frame_state(self.recorded)
        return {
            **add_prefix("frame", frame_state(self.frame)),
            **add_prefix("relevance", relevance_state(self.relevance)),
            **add_prefix("recorded", recorded),
            **({} if self.hidden is None else {"hidden": self.hidden}),
            "counts": int_array(self.evaluated, self.anchor),
        }

    @classmethod
    def from_state(cls, state: State) -> Keyframe:
        """Return the keyframe that `state` described. Raises MapFileError, InvalidInputError."""
        frame = frame_from_state(select_prefix(state, "frame"))
        recorded = select_prefix(state, "recorded")
        relevance = relevance_from_state(select_prefix(state, "relevance"), frame)
        evaluated, anchor = get_counts(state, "counts", 2)
        hidden = get_array(state, "hidden", frame.depth_m.shape, np.bool_).copy() if "hidden" in state else None
        return cls(frame, relevance, frame_from_state(recorded) if recorded else None, bool(evaluated), anchor, hidden)


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
    """A keyframe prepared for training."""

    keyframe: Keyframe
    training_view: TrainingView  # prepared by the rasterizer, whole or masked to the ROI's tiles
    half_view: TrainingView | None  # in half size, for iterations on whole images; None: they use training_view
    T_camera_world: Float64[ndarray, "4 4"]
    roi: Subset  # the 16x16 tiles that touch the ROI or its margin

    @property
    def shows_roi(self) -> bool:
        """True if a pixel belongs to the ROI."""
        return self.roi.tiles is not None and bool(self.roi.tiles.any())

    @property
    def roi_share(self) -> float:
        """Share of the image's tiles that the active phase renders."""
        return 1.0 if self.roi.tiles is None else float(self.roi.tiles.mean())


def window_view(keyframe: Keyframe, rasterizer: Rasterizer, settings: KeyframeSettings) -> WindowView:
    """Prepare a keyframe for training. The margin gives the SSIM window its neighbours at the ROI's border."""
    frame = keyframe.frame
    tiles, pixel_weights = roi_weights(keyframe.relevance.pixel_weights, settings.roi_context_weight)
    depth_m = without_depth_edges(frame.depth_m, settings.depth_edge_px)
    return WindowView(
        keyframe=keyframe,
        training_view=rasterizer.prepare_view(frame.rgb, depth_m, frame.camera, pixel_weights, frame.motion),
        half_view=_half_view(frame, depth_m, rasterizer) if depth_m.size >= settings.half_size_from_px else None,
        T_camera_world=inverse(frame.T_world_camera),
        roi=Subset(tiles),
    )


def _half_view(frame: Frame, depth_m: Float32[ndarray, "h w"], rasterizer: Rasterizer) -> TrainingView:
    """Prepare the image in half size: colours averaged over 2x2 pixels, depths too where all four are measured."""
    width, height = frame.camera.width_px // 2, frame.camera.height_px // 2
    rgb, halved_m, measured = (
        cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        for image in (frame.rgb, depth_m, (depth_m > 0).astype(np.float32))
    )
    halved_m = np.where(measured > _ALL_MEASURED, halved_m, np.float32(0.0))
    camera = frame.camera.resized(width, height)
    return rasterizer.prepare_view(rgb, halved_m, camera, None, frame.motion, _HALF_SIZE_DILATION_PX2)


def roi_weights(
    pixel_weights: Float32[ndarray, "h w"], context_weight: float
) -> tuple[Bool[ndarray, "th tw"], Float32[ndarray, "h w"]]:
    """Return the tiles of the pixels with a weight, and the weights with those of the other pixels inside the tiles."""
    tiles = tiles_touching(pixel_weights > 0, _ROI_MARGIN_PX)
    if context_weight > 0:
        context = np.float32(context_weight) * _pixels_inside(tiles, pixel_weights.shape)
        pixel_weights = np.maximum(pixel_weights, context)
    return tiles, pixel_weights


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


PrepareView = Callable[[Keyframe], WindowView]
"""Prepares a keyframe for training (`window_view`)."""


class KeyframeStore:
    """Every `every`th mapped frame is a keyframe: the `window` most recent train the map, `buffer` are kept.

    `long_term_keyframes` more frames that show the ROI train the map, and as many others, both spread over the mission.
    Of frames equally close in time, sharp ones stay. Large images reduce all numbers (`KeyframeSettings.max_pixels`).
    """

    def __init__(self, settings: KeyframeSettings) -> None:
        self._settings = self._limits = settings
        self._largest_px = 1
        self._keyframes: dict[FrameId, Keyframe] = {}
        self._views: dict[FrameId, WindowView] = {}
        self._recent: list[FrameId] = []
        self._long_term: list[FrameId] = []
        self._buffer: list[FrameId] = []
        self._mapped_frames = self._count = 0

    @property
    def window(self) -> tuple[WindowView, ...]:
        """The views to train on: long-term ones, then the most recent ones, each oldest first and none twice."""
        long_term = [frame for frame in self._long_term if frame not in self._recent]
        return tuple(self._views[frame] for frame in (*long_term, *self._recent))

    @property
    def buffer(self) -> tuple[Keyframe, ...]:
        """Keyframes of the whole mission, oldest first, thinned evenly if the buffer is full."""
        return tuple(self._keyframes[frame] for frame in self._buffer)

    @property
    def kept(self) -> tuple[Keyframe, ...]:
        """Every keyframe of the buffer and of the window once, by capture time."""
        keyframes = (self._keyframes[frame] for frame in self._ids())
        return tuple(sorted(keyframes, key=lambda keyframe: keyframe.frame.capture_time_ns))

    @property
    def next_anchor(self) -> int:
        """Number of the keyframe that the next frame follows: its own, or that of the newest keyframe."""
        return self._count if self.next_is_keyframe else self._count - 1

    @property
    def count(self) -> int:
        """Number of keyframes of the mission."""
        return self._count

    @property
    def next_is_keyframe(self) -> bool:
        """True if the next frame is a keyframe."""
        return self._mapped_frames % self._settings.every == 0

    def add(self, view: WindowView) -> None:
        """Store a mapped frame for the long term and, if it is the next `every`th one, among the most recent ones.

        A frame whose id is kept already, of a recording that is played again, is replaced.
        """
        self._limit_for(view.keyframe)
        is_keyframe = self.next_is_keyframe
        self._mapped_frames += 1
        self._count += is_keyframe
        new = view.keyframe.frame.id
        for frames in (self._recent, self._long_term, self._buffer):
            if new in frames:
                frames.remove(new)
        self._keyframes[new], self._views[new] = view.keyframe, view
        # any mapped frame may stay for the long term, if it shows the ROI better than those kept
        self._set_long_term([*self._long_term, new])
        if is_keyframe:
            self._recent = [*self._recent, new][-self._limits.window :]
            self._buffer.append(new)
            while len(self._buffer) > self._limits.buffer:
                del self._buffer[_most_redundant(self.buffer)]
        # drop unused frames only now: `get` finds the last frame until the next one comes
        self._keyframes = {frame: self._keyframes[frame] for frame in self._ids()}
        self._views = {frame: self._views[frame] for frame in (*self._recent, *self._long_term)}

    def get(self, frame: FrameId) -> Keyframe | None:
        """Return the keyframe of a frame, or None if none is kept."""
        return self._keyframes.get(frame)

    def replace(self, keyframe: Keyframe, prepare: PrepareView | None) -> None:
        """Replace the keyframe of the same frame, if it is kept; prepare: None if no pixel and no pose has changed."""
        frame = keyframe.frame.id
        if frame not in self._keyframes:
            return
        self._keyframes[frame] = keyframe
        if frame in self._views:
            view = replace(self._views[frame], keyframe=keyframe) if prepare is None else prepare(keyframe)
            self._views[frame] = view
            self._set_long_term(self._long_term)

    def replace_relevance(self, keyframe: Keyframe, prepare: PrepareView) -> None:
        """Replace the keyframe of the same frame, if it is kept; one that shows the ROI joins the window again."""
        frame = keyframe.frame.id
        self.replace(keyframe, prepare)
        if frame not in self._keyframes or frame in self._long_term or not keyframe.relevance.roi.any():
            return
        if frame not in self._views:
            self._views[frame] = prepare(keyframe)
        self._set_long_term(sorted([*self._long_term, frame], key=self._capture_time_ns))

    def reset_roi(self) -> None:
        """Mark all keyframes as not evaluated for the new task; their relevance is empty until then."""
        shapes = {keyframe.frame.depth_m.shape for keyframe in self._keyframes.values()}
        empty = {shape: RelevanceMap.empty(*shape) for shape in shapes}
        self._update_all(
            lambda keyframe: replace(keyframe, relevance=empty[keyframe.frame.depth_m.shape], evaluated=False),
            lambda view: replace(view, roi=_no_tiles(view.keyframe.frame)),
        )

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move all keyframes with their anchors, given the motions by keyframe number."""
        self._update_all(
            lambda keyframe: keyframe.moved(T_corrected_earlier),
            lambda view: replace(view, T_camera_world=inverse(view.keyframe.frame.T_world_camera)),
        )

    def _update_all(self, update: Callable[[Keyframe], Keyframe], of_view: Callable[[WindowView], WindowView]) -> None:
        self._keyframes = {frame: update(keyframe) for frame, keyframe in self._keyframes.items()}
        self._views = {
            frame: of_view(replace(view, keyframe=self._keyframes[frame])) for frame, view in self._views.items()
        }

    @property
    def next_unevaluated(self) -> Keyframe | None:
        """The newest keyframe not evaluated for the present task, or None."""
        return next((keyframe for keyframe in self._newest_first() if not keyframe.evaluated), None)

    def next_incomplete(self, known_objects: int) -> Keyframe | None:
        """The newest evaluated keyframe whose relevance was estimated with fewer known objects, or None."""
        newest_first = self._newest_first()
        return next((k for k in newest_first if k.evaluated and k.relevance.known_objects < known_objects), None)

    @property
    def image_bytes(self) -> int:
        """Memory of all keyframes' images, without the data that the rasterizer prepares for the window."""
        return sum(array.nbytes for keyframe in self.kept for array in keyframe.state().values())

    def state(self) -> State:
        """Return all keyframes once, and their numbers in the three lists."""
        number = {frame: i for i, frame in enumerate(self._ids())}
        state: dict[str, NDArray[Any]] = {
            "recent": int_array(*(number[frame] for frame in self._recent)),
            "long_term": int_array(*(number[frame] for frame in self._long_term)),
            "buffer": int_array(*(number[frame] for frame in self._buffer)),
            "counts": int_array(self._mapped_frames, self._count),
        }
        for frame, i in number.items():
            state |= add_prefix(str(i), self._keyframes[frame].state())
        return state

    def restore(self, state: State, prepare: PrepareView) -> None:
        """Replace all keyframes by those of another store of the same settings. Raises MapFileError."""
        limits = {
            "recent": self._settings.window,
            "long_term": 2 * self._settings.long_term_keyframes,
            "buffer": self._settings.buffer,
        }
        numbers = {name: get_counts(state, name, len(state.get(name, ()))) for name in limits}
        for name, limit in limits.items():
            if len(numbers[name]) > limit:
                raise MapFileError(f"state keyframes {name}: expected at most {limit}, got {len(numbers[name])}")
        stored = sorted({i for number in numbers.values() for i in number})
        keyframes = {i: Keyframe.from_state(select_prefix(state, str(i))) for i in stored}
        self._keyframes = {keyframe.frame.id: keyframe for keyframe in keyframes.values()}
        self._recent, self._long_term, self._buffer = (
            list(dict.fromkeys(keyframes[i].frame.id for i in numbers[name])) for name in limits
        )
        in_window = dict.fromkeys([*self._recent, *self._long_term])
        self._views = {frame: prepare(self._keyframes[frame]) for frame in in_window}
        for keyframe in keyframes.values():
            self._limit_for(keyframe)
        self._mapped_frames, self._count = get_counts(state, "counts", 2)

    def _limit_for(self, keyframe: Keyframe) -> None:
        """Reduce the limits if this image is the largest so far."""
        pixels = keyframe.frame.depth_m.size
        if pixels > self._largest_px:
            self._largest_px = pixels
            self._limits = self._settings.for_image_size(pixels)

    def _set_long_term(self, frames: list[FrameId]) -> None:
        """Keep these long-term views, of those with and of those without the ROI each the least redundant ones."""
        kept: set[FrameId] = set()
        for shows_roi in (True, False):
            kind = [frame for frame in frames if self._views[frame].shows_roi == shows_roi]
            while len(kind) > self._limits.long_term_keyframes:
                del kind[_most_redundant([self._keyframes[frame] for frame in kind])]
            kept.update(kind)
        self._long_term = [frame for frame in frames if frame in kept]

    def _ids(self) -> list[FrameId]:
        """Return every kept frame once, the buffer's first."""
        return list(dict.fromkeys([*self._buffer, *self._recent, *self._long_term]))

    def _capture_time_ns(self, frame: FrameId) -> int:
        return self._keyframes[frame].frame.capture_time_ns

    def _newest_first(self) -> Iterator[Keyframe]:
        """Yield the window's keyframes, then the buffer's, each the newest first."""
        return itertools.chain((view.keyframe for view in reversed(self.window)), reversed(self.buffer))


def _no_tiles(frame: Frame) -> Subset:
    return Subset(tiles_touching(np.zeros(frame.depth_m.shape, np.bool_), margin_px=0))


def _most_redundant(keyframes: Sequence[Keyframe]) -> int:
    """Return the index of the keyframe closest in time to its neighbours, never the first or the last one.

    Motion blur counts as if the neighbours were closer.
    """
    times = np.array([keyframe.frame.capture_time_ns for keyframe in keyframes])
    gaps = np.abs(times[2:] - times[:-2])  # the clock of a second recording may restart
    blur_px = np.array([motion_blur_px(keyframe.frame) for keyframe in keyframes[1:-1]])
    return 1 + int(np.argmin(gaps / (1.0 + blur_px**2))) if len(gaps) else 0
