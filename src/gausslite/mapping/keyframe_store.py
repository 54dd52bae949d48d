"""Choose the keyframes that train the map, those for the long term, and those to keep (Sec. III-D.2, III-E)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame, FrameId
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_counts, int_array, select_prefix
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.settings import KeyframeSettings
from gausslite.mapping.window_view import WindowView, tiles_touching
from gausslite.render.rasterizer import Subset

_DEPTH_STEP_PX = 8


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
        self._mapped_frames = self.count = 0  # count: keyframes of the whole mission

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
        return self.count if self.next_is_keyframe else self.count - 1

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
        self.count += is_keyframe
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
                del self._buffer[_most_redundant(self.buffer)]  # thinned evenly: the whole mission stays covered
        # drop unused frames only now: `get` finds the last frame until the next one comes
        self._keyframes = {frame: self._keyframes[frame] for frame in self._ids()}
        self._views = {frame: self._views[frame] for frame in (*self._recent, *self._long_term)}

    def keep_images(self, keep: Callable[[Keyframe], Keyframe]) -> None:
        """Replace each keyframe that does not train by what `keep` returns for it."""
        idle = {frame: keep(keyframe) for frame, keyframe in self._keyframes.items() if frame not in self._views}
        self._keyframes |= idle

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
        by_time = sorted([*self._long_term, frame], key=lambda own: self._keyframes[own].frame.capture_time_ns)
        self._set_long_term(by_time)

    def reset_roi(self) -> None:
        """Mark all keyframes as not evaluated for the new task; their relevance is empty until then."""
        shapes = {keyframe.frame.depth_m.shape for keyframe in self._keyframes.values()}
        empty = {shape: RelevanceMap.empty(*shape) for shape in shapes}
        no_tiles = {shape: Subset(tiles_touching(np.zeros(shape, np.bool_), margin_px=0)) for shape in shapes}
        self._update_all(
            lambda keyframe: replace(keyframe, relevance=empty[keyframe.frame.depth_m.shape], evaluated=False),
            lambda view: replace(view, roi=no_tiles[view.keyframe.frame.depth_m.shape]),
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
            "counts": int_array(self._mapped_frames, self.count),
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
        self._mapped_frames, self.count = get_counts(state, "counts", 2)

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
                # both kinds: views without the region keep the background
                del kind[_most_redundant([self._keyframes[frame] for frame in kind])]
            kept.update(kind)
        self._long_term = [frame for frame in frames if frame in kept]

    def _ids(self) -> list[FrameId]:
        """Return every kept frame once, the buffer's first."""
        return list(dict.fromkeys([*self._buffer, *self._recent, *self._long_term]))

    def _newest_first(self) -> Iterator[Keyframe]:
        """Yield the window's keyframes, then the buffer's, each the newest first."""
        return itertools.chain((view.keyframe for view in reversed(self.window)), reversed(self.buffer))


def _most_redundant(keyframes: Sequence[Keyframe]) -> int:
    """Return the index of the keyframe closest in time to its neighbours, never the first or the last one.

    Motion blur counts as if the neighbours were closer.
    """
    times = np.array([keyframe.frame.capture_time_ns for keyframe in keyframes])
    gaps = np.abs(times[2:] - times[:-2])  # the clock of a second recording may restart
    blur_px = np.array([motion_blur_px(keyframe.frame) for keyframe in keyframes[1:-1]])
    return 1 + int(np.argmin(gaps / (1.0 + blur_px**2))) if len(gaps) else 0
