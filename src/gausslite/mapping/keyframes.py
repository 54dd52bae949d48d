"""Remember the frames to train on: a window of recent ones ready for the rasterizer, and a buffer of the mission."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, nested, part, take_counts, whole_numbers
from gausslite.errors import MapFileError
from gausslite.mapping.checkpoint import frame_of, frame_state, relevance_of, relevance_state
from gausslite.mapping.settings import KeyframeSettings
from gausslite.render.rasterizer import TILE_PX, Rasterizer, TrainingView

_SSIM_WINDOW_PX = 11


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame and what in it was relevant when it was mapped.

    recorded: the frame as it came, where it is mapped with another pose or other colours; None where it is not.
    judged: False while what in it is relevant to the present task is not known; nothing is marked then.
    """

    frame: Frame
    relevance: RelevanceMap
    recorded: Frame | None = None
    judged: bool = True

    @property
    def as_recorded(self) -> Frame:
        """The frame as it came."""
        return self.frame if self.recorded is None else self.recorded

    def state(self) -> State:
        """The keyframe as named arrays."""
        recorded = {} if self.recorded is None else frame_state(self.recorded)
        return {
            **nested("frame", frame_state(self.frame)),
            **nested("relevance", relevance_state(self.relevance)),
            **nested("recorded", recorded),
            "judged": whole_numbers(self.judged),
        }

    @classmethod
    def of(cls, state: State) -> Keyframe:
        """The keyframe again. Raises MapFileError, InvalidInputError."""
        frame = frame_of(part(state, "frame"))
        recorded = part(state, "recorded")
        relevance = relevance_of(part(state, "relevance"), frame)
        [judged] = take_counts(state, "judged", 1)
        return cls(frame, relevance, frame_of(recorded) if recorded else None, bool(judged))


@dataclass(frozen=True, slots=True, eq=False)
class WindowView:
    """A keyframe made ready to train on. active_tiles: the 16x16 tiles that touch the region and its margin."""

    keyframe: Keyframe
    training_view: TrainingView
    T_camera_world: Float64[ndarray, "4 4"]
    active_tiles: Bool[ndarray, "th tw"]

    @property
    def shows_region(self) -> bool:
        """True when any pixel belongs to the task's region."""
        return bool(self.active_tiles.any())


def window_view(keyframe: Keyframe, rasterizer: Rasterizer, settings: KeyframeSettings) -> WindowView:
    """Make a frame ready to train on; the margin gives SSIM's window its neighbours at the region's border."""
    frame, relevance = keyframe.frame, keyframe.relevance
    tiles, weight = tiles_of(relevance.roi, settings.roi_margin_px), relevance.weight
    if settings.surroundings_weight > 0:
        beside = np.float32(settings.surroundings_weight) * _well_inside(tiles, weight.shape)
        weight = np.maximum(weight, beside)
    return WindowView(
        keyframe=keyframe,
        training_view=rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera, weight),
        T_camera_world=inverse(frame.T_world_camera),
        active_tiles=tiles,
    )


def _well_inside(tiles: Bool[ndarray, "th tw"], shape: tuple[int, ...]) -> Bool[ndarray, "h w"]:
    """Pixels whose whole SSIM window lies in these tiles: beyond them nothing is drawn to compare with."""
    drawn = np.repeat(np.repeat(tiles, TILE_PX, axis=0), TILE_PX, axis=1)[: shape[0], : shape[1]]
    return cv2.erode(drawn.astype(np.uint8), np.ones((_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), np.uint8)) > 0


def tiles_of(region: Bool[ndarray, "h w"], margin_px: int) -> Bool[ndarray, "th tw"]:
    """The tiles that touch the region grown by margin_px."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    grown = cv2.dilate(region.astype(np.uint8), kernel)
    by_rows = np.maximum.reduceat(grown, np.arange(0, grown.shape[0], TILE_PX), axis=0)
    tiles: Bool[ndarray, "th tw"] = np.maximum.reduceat(by_rows, np.arange(0, grown.shape[1], TILE_PX), axis=1) > 0
    return tiles


class KeyframeStore:
    """Every `every`th mapped frame; the latest `window` are ready to train on, at most `buffer` are remembered."""

    def __init__(self, settings: KeyframeSettings) -> None:
        self._settings = settings
        self._window: list[WindowView] = []
        self._buffer: list[Keyframe] = []
        self._offered = 0

    @property
    def window(self) -> tuple[WindowView, ...]:
        """The most recent keyframes, oldest first."""
        return tuple(self._window)

    @property
    def buffer(self) -> tuple[Keyframe, ...]:
        """Keyframes of the whole mission, oldest first, thinned evenly once the buffer is full."""
        return tuple(self._buffer)

    def offer(self, view: WindowView) -> None:
        """Keep this mapped frame if it is the turn of a keyframe."""
        due = self._offered % self._settings.every == 0
        self._offered += 1
        if not due:
            return
        self._window = [*self._window, view][-self._settings.window :]
        self._buffer.append(view.keyframe)
        if len(self._buffer) > self._settings.buffer:
            self._thin()

    def revise(self, view: WindowView) -> None:
        """Put what came to be known later in the place of a frame that is still in the window."""
        self._window = [view if _same_frame(old.keyframe, view.keyframe) else old for old in self._window]
        self._buffer = [view.keyframe if _same_frame(old, view.keyframe) else old for old in self._buffer]

    def begin_task(self) -> None:
        """The task is another one: no keyframe is judged, and none shows a region before it is."""
        nothing = {k.frame.depth_m.shape: RelevanceMap.nothing(*k.frame.depth_m.shape) for k in self._held()}
        fresh = {
            id(old): replace(old, relevance=nothing[old.frame.depth_m.shape], judged=False) for old in self._held()
        }
        self._buffer = [fresh[id(keyframe)] for keyframe in self._buffer]
        self._window = [
            replace(view, keyframe=fresh[id(view.keyframe)], active_tiles=np.zeros_like(view.active_tiles))
            for view in self._window
        ]

    @property
    def next_to_judge(self) -> Keyframe | None:
        """The newest keyframe that is not judged; None when all are."""
        newest_first = (*(view.keyframe for view in reversed(self._window)), *reversed(self._buffer))
        return next((keyframe for keyframe in newest_first if not keyframe.judged), None)

    def judge(self, keyframe: Keyframe, view_of: Callable[[Keyframe], WindowView]) -> None:
        """Put a judged keyframe in its place; one that shows the region comes back into the window if there is room.

        Room is made by the oldest view that is judged and does not show it.
        """
        self._buffer = [keyframe if _same_frame(old, keyframe) else old for old in self._buffer]
        if any(_same_frame(view.keyframe, keyframe) for view in self._window):
            self.revise(view_of(keyframe))
        elif keyframe.relevance.roi.any() and self._make_room():
            # it is older than all that were judged before it
            self._window.insert(0, view_of(keyframe))

    def of(self, frame: Frame) -> WindowView | None:
        """The window's view of a frame as it came; None where it is no keyframe of the window (any more)."""
        return next((view for view in self._window if view.keyframe.as_recorded is frame), None)

    @property
    def image_bytes(self) -> int:
        """Memory of all keyframes' images, without what the rasterizer prepares of those in the window."""
        return sum(array.nbytes for keyframe in self._held() for array in keyframe.state().values())

    def state(self) -> State:
        """All keyframes once, and which of them are the window and which the buffer."""
        window = [view.keyframe for view in self._window]
        places = {id(keyframe): place for place, keyframe in enumerate(self._held())}
        state: dict[str, NDArray[Any]] = {
            "window": whole_numbers(*(places[id(keyframe)] for keyframe in window)),
            "buffer": whole_numbers(*(places[id(keyframe)] for keyframe in self._buffer)),
            "offered": whole_numbers(self._offered),
        }
        for place, keyframe in enumerate(self._held()):
            state |= nested(str(place), keyframe.state())
        return state

    def restore(self, state: State, view_of: Callable[[Keyframe], WindowView]) -> None:
        """Take over the keyframes of another store; view_of makes one ready to train on. Raises MapFileError."""
        window, buffer = (take_counts(state, name, len(state.get(name, ()))) for name in ("window", "buffer"))
        if len(window) > self._settings.window or len(buffer) > self._settings.buffer:
            raise MapFileError(
                f"state keyframes: expected at most {self._settings.window} and {self._settings.buffer}, "
                f"got {len(window)} and {len(buffer)}"
            )
        keyframes = {place: Keyframe.of(part(state, str(place))) for place in sorted({*window, *buffer})}
        self._window = [view_of(keyframes[place]) for place in window]
        self._buffer = [keyframes[place] for place in buffer]
        [self._offered] = take_counts(state, "offered", 1)

    def _held(self) -> list[Keyframe]:
        """Every keyframe once."""
        return list(dict.fromkeys([*self._buffer, *(view.keyframe for view in self._window)]))

    def _make_room(self) -> bool:
        """Let one view go from a full window that does without it; False where all of them are needed."""
        if len(self._window) < self._settings.window:
            return True
        idle = [i for i, view in enumerate(self._window) if view.keyframe.judged and not view.shows_region]
        if idle:
            del self._window[idle[0]]
        return bool(idle)

    def _thin(self) -> None:
        """Drop the keyframe that is closest in time to its neighbours; the first and the last stay."""
        times = np.array([keyframe.frame.capture_time_ns for keyframe in self._buffer])
        gaps = times[2:] - times[:-2]
        drop = 1 + int(np.argmin(gaps)) if len(gaps) else 0
        del self._buffer[drop]


def _same_frame(a: Keyframe, b: Keyframe) -> bool:
    return a.as_recorded is b.as_recorded
