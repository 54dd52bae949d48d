"""The keyframes of a mission: the window that MVO trains on (Sec. III-D.2) and the buffer for joint refinement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_counts, int_array, select_prefix
from gausslite.mapping.keyframes import Keyframe, WindowView, is_same_frame, motion_blur_px, tiles_touching
from gausslite.mapping.settings import KeyframeSettings
from gausslite.render.rasterizer import Subset

PrepareView = Callable[[Keyframe], WindowView]
"""Prepares a keyframe for training (`window_view`)."""


class KeyframeStore:
    """Every `every`th mapped frame is a keyframe: the `window` most recent train the map, `buffer` are kept.

    `long_term_keyframes` more frames train the map, spread over the mission: those that show the ROI, or any frames if
    the policy follows no task. Of frames equally close in time, sharp ones stay. Large images reduce all three numbers
    (`KeyframeSettings.max_pixels`).
    """

    def __init__(self, settings: KeyframeSettings, follows_task: bool = True) -> None:
        self._settings = self._limits = settings
        self._follows_task = follows_task
        self._largest_px = 1
        self._recent: list[WindowView] = []
        self._long_term: list[WindowView] = []
        self._buffer: list[Keyframe] = []
        self._mapped_frames = 0

    @property
    def window(self) -> tuple[WindowView, ...]:
        """The views to train on: long-term ones, then the most recent ones, each oldest first and none twice."""
        recent = {id(view.keyframe) for view in self._recent}
        return (*(view for view in self._long_term if id(view.keyframe) not in recent), *self._recent)

    @property
    def buffer(self) -> tuple[Keyframe, ...]:
        """Keyframes of the whole mission, oldest first, thinned evenly if the buffer is full."""
        return tuple(self._buffer)

    @property
    def kept(self) -> tuple[Keyframe, ...]:
        """Every keyframe of the buffer and of the window once, by capture time."""
        return tuple(sorted(self._keyframes(), key=lambda keyframe: keyframe.frame.capture_time_ns))

    def add(self, view: WindowView) -> None:
        """Store a mapped frame if it shows the ROI or is the next `every`th frame."""
        self._limit_for(view.keyframe)
        is_keyframe = self._mapped_frames % self._settings.every == 0
        self._mapped_frames += 1
        if self._is_long_term(view):
            self._set_long_term([*self._long_term, view])
        if not is_keyframe:
            return
        self._recent = [*self._recent, view][-self._limits.window :]
        self._buffer.append(view.keyframe)
        while len(self._buffer) > self._limits.buffer:
            del self._buffer[_most_redundant(self._buffer)]

    def replace_view(self, view: WindowView) -> None:
        """Replace the view of the same recorded frame, if it is in the window.

        A view that no longer shows the ROI stays only among the most recent keyframes.
        """
        long_term = [view if is_same_frame(old.keyframe, view.keyframe) else old for old in self._long_term]
        self._long_term = [each for each in long_term if self._is_long_term(each) or not each.keyframe.evaluated]
        self._recent = [view if is_same_frame(old.keyframe, view.keyframe) else old for old in self._recent]
        self._buffer = [view.keyframe if is_same_frame(old, view.keyframe) else old for old in self._buffer]

    def reset_roi(self) -> None:
        """Mark all keyframes as not evaluated for the new task; their relevance is empty until then."""
        keyframes = self._keyframes()
        empty = {k.frame.depth_m.shape: RelevanceMap.empty(*k.frame.depth_m.shape) for k in keyframes}
        fresh = {id(old): replace(old, relevance=empty[old.frame.depth_m.shape], evaluated=False) for old in keyframes}
        self._buffer = [fresh[id(keyframe)] for keyframe in self._buffer]
        views = {
            id(view.keyframe): replace(view, keyframe=fresh[id(view.keyframe)], roi=_no_tiles(view.keyframe.frame))
            for view in self.window
        }
        self._recent = [views[id(view.keyframe)] for view in self._recent]
        self._long_term = [views[id(view.keyframe)] for view in self._long_term]

    @property
    def next_unevaluated(self) -> Keyframe | None:
        """The newest keyframe not evaluated for the present task, or None."""
        newest_first = (*(view.keyframe for view in reversed(self.window)), *reversed(self._buffer))
        return next((keyframe for keyframe in newest_first if not keyframe.evaluated), None)

    def next_incomplete(self, known_objects: int) -> Keyframe | None:
        """The newest evaluated keyframe whose relevance was estimated with fewer known objects, or None."""
        newest_first = (*(view.keyframe for view in reversed(self.window)), *reversed(self._buffer))
        return next((k for k in newest_first if k.evaluated and k.relevance.known_objects < known_objects), None)

    def replace_keyframe(self, keyframe: Keyframe) -> None:
        """Replace a keyframe by a version whose relevance has the same pixels."""
        self._recent, self._long_term = (
            [replace(view, keyframe=keyframe) if is_same_frame(view.keyframe, keyframe) else view for view in views]
            for views in (self._recent, self._long_term)
        )
        self._buffer = [keyframe if is_same_frame(old, keyframe) else old for old in self._buffer]

    def set_evaluated(self, keyframe: Keyframe, prepare: PrepareView) -> None:
        """Replace a keyframe by its evaluated version; one that shows the ROI joins the window again."""
        self._buffer = [keyframe if is_same_frame(old, keyframe) else old for old in self._buffer]
        shows_roi = bool(keyframe.relevance.roi.any())
        in_window = any(is_same_frame(view.keyframe, keyframe) for view in self.window)
        if not in_window and not shows_roi:
            return
        view = prepare(keyframe)
        self.replace_view(view)
        if shows_roi and not any(is_same_frame(each.keyframe, keyframe) for each in self._long_term):
            self._set_long_term(sorted([*self._long_term, view], key=_capture_time_ns))

    def find(self, recorded: Frame) -> WindowView | None:
        """Return the window's view of a recorded frame, or None if the window has none."""
        return next((view for view in self.window if view.keyframe.as_recorded is recorded), None)

    @property
    def image_bytes(self) -> int:
        """Memory of all keyframes' images, without the data that the rasterizer prepares for the window."""
        return sum(array.nbytes for keyframe in self._keyframes() for array in keyframe.state().values())

    def state(self) -> State:
        """Return all keyframes once, and their numbers in the three lists."""
        keyframes = self._keyframes()
        number = {id(keyframe): i for i, keyframe in enumerate(keyframes)}
        state: dict[str, NDArray[Any]] = {
            "recent": int_array(*(number[id(view.keyframe)] for view in self._recent)),
            "long_term": int_array(*(number[id(view.keyframe)] for view in self._long_term)),
            "buffer": int_array(*(number[id(keyframe)] for keyframe in self._buffer)),
            "mapped_frames": int_array(self._mapped_frames),
        }
        for i, keyframe in enumerate(keyframes):
            state |= add_prefix(str(i), keyframe.state())
        return state

    def restore(self, state: State, prepare: PrepareView) -> None:
        """Replace all keyframes by those of another store of the same settings. Raises MapFileError."""
        limits = {
            "recent": self._settings.window,
            "long_term": self._settings.long_term_keyframes,
            "buffer": self._settings.buffer,
        }
        numbers = {name: get_counts(state, name, len(state.get(name, ()))) for name in limits}
        for name, limit in limits.items():
            if len(numbers[name]) > limit:
                raise MapFileError(f"state keyframes {name}: expected at most {limit}, got {len(numbers[name])}")
        stored = sorted({i for each in numbers.values() for i in each})
        keyframes = {i: Keyframe.from_state(select_prefix(state, str(i))) for i in stored}
        views = {i: prepare(keyframes[i]) for i in sorted({*numbers["recent"], *numbers["long_term"]})}
        self._recent = [views[i] for i in numbers["recent"]]
        self._long_term = [views[i] for i in numbers["long_term"]]
        self._buffer = [keyframes[i] for i in numbers["buffer"]]
        for keyframe in keyframes.values():
            self._limit_for(keyframe)
        [self._mapped_frames] = get_counts(state, "mapped_frames", 1)

    def _limit_for(self, keyframe: Keyframe) -> None:
        """Reduce the limits if this image is the largest so far."""
        pixels = keyframe.frame.depth_m.size
        if pixels > self._largest_px:
            self._largest_px = pixels
            self._limits = self._settings.for_image_size(pixels)

    def _is_long_term(self, view: WindowView) -> bool:
        """True if the view may train the map after it leaves the most recent keyframes."""
        return view.shows_roi or not self._follows_task

    def _set_long_term(self, views: list[WindowView]) -> None:
        """Keep these long-term views, without the most redundant ones beyond the limit."""
        while len(views) > self._limits.long_term_keyframes:
            del views[_most_redundant([view.keyframe for view in views])]
        self._long_term = views

    def _keyframes(self) -> list[Keyframe]:
        """Return every keyframe once, the buffer's first."""
        views = (*self._recent, *self._long_term)
        return list(dict.fromkeys([*self._buffer, *(view.keyframe for view in views)]))


def _no_tiles(frame: Frame) -> Subset:
    return Subset(tiles_touching(np.zeros(frame.depth_m.shape, np.bool_), margin_px=0))


def _capture_time_ns(view: WindowView) -> int:
    return view.keyframe.frame.capture_time_ns


def _most_redundant(keyframes: Sequence[Keyframe]) -> int:
    """Return the index of the keyframe closest in time to its neighbours, never the first or the last one.

    Motion blur counts as if the neighbours were closer.
    """
    times = np.array([keyframe.frame.capture_time_ns for keyframe in keyframes])
    gaps = np.abs(times[2:] - times[:-2])  # the clock of a second recording may restart
    blur_px = np.array([motion_blur_px(keyframe.frame) for keyframe in keyframes[1:-1]])
    return 1 + int(np.argmin(gaps / (1.0 + blur_px**2))) if len(gaps) else 0
