"""Remember the frames to train on: a window of recent ones ready for the rasterizer, and a buffer of the mission."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from gausslite.domain.state import State, add_prefix, get_counts, int_array, select_prefix
from gausslite.errors import MapFileError
from gausslite.mapping.checkpoint import frame_of, frame_state, relevance_of, relevance_state
from gausslite.mapping.settings import KeyframeSettings
from gausslite.render.rasterizer import TILE_PX, Rasterizer, Subset, TrainingView

_SSIM_WINDOW_PX = 11


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame and what in it was relevant when it was mapped.

    recorded: the frame as it came, where it is mapped with another pose or other colours; None where it is not.
    evaluated: False while what in it is relevant to the present task is not known; nothing is marked then.
    """

    frame: Frame
    relevance: RelevanceMap
    recorded: Frame | None = None
    evaluated: bool = True

    @property
    def as_recorded(self) -> Frame:
        """The frame as it came."""
        return self.frame if self.recorded is None else self.recorded

    def state(self) -> State:
        """The keyframe as named arrays."""
        recorded = {} if self.recorded is None else frame_state(self.recorded)
        return {
            **add_prefix("frame", frame_state(self.frame)),
            **add_prefix("relevance", relevance_state(self.relevance)),
            **add_prefix("recorded", recorded),
            "evaluated": int_array(self.evaluated),
        }

    @classmethod
    def of(cls, state: State) -> Keyframe:
        """The keyframe again. Raises MapFileError, InvalidInputError."""
        frame = frame_of(select_prefix(state, "frame"))
        recorded = select_prefix(state, "recorded")
        relevance = relevance_of(select_prefix(state, "relevance"), frame)
        [evaluated] = get_counts(state, "evaluated", 1)
        return cls(frame, relevance, frame_of(recorded) if recorded else None, bool(evaluated))


@dataclass(frozen=True, slots=True, eq=False)
class WindowView:
    """A keyframe made ready to train on. region: the 16x16 tiles that touch the task's region and its margin."""

    keyframe: Keyframe
    training_view: TrainingView
    T_camera_world: Float64[ndarray, "4 4"]
    region: Subset

    @property
    def shows_region(self) -> bool:
        """True when any pixel belongs to the task's region."""
        return self.region.tiles is not None and bool(self.region.tiles.any())


def window_view(keyframe: Keyframe, rasterizer: Rasterizer, settings: KeyframeSettings) -> WindowView:
    """Make a frame ready to train on; the margin gives SSIM's window its neighbours at the region's border."""
    frame, relevance = keyframe.frame, keyframe.relevance
    tiles, weight = tiles_of(relevance.roi, settings.roi_margin_px), relevance.weight
    if settings.roi_context_weight > 0:
        beside = np.float32(settings.roi_context_weight) * _well_inside(tiles, weight.shape)
        weight = np.maximum(weight, beside)
    return WindowView(
        keyframe=keyframe,
        training_view=rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera, weight),
        T_camera_world=inverse(frame.T_world_camera),
        region=Subset(tiles),
    )


def _well_inside(tiles: Bool[ndarray, "th tw"], shape: tuple[int, ...]) -> Bool[ndarray, "h w"]:
    """Pixels whose whole SSIM window lies in these tiles: beyond them nothing is drawn to compare with."""
    drawn = np.repeat(np.repeat(tiles, TILE_PX, axis=0), TILE_PX, axis=1)[: shape[0], : shape[1]]
    return cv2.erode(drawn.astype(np.uint8), np.ones((_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), np.uint8)) > 0


def tiles_of(region: Bool[ndarray, "h w"], margin_px: int) -> Bool[ndarray, "th tw"]:
    """The tiles that touch the region grown by margin_px."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    grown = cv2.dilate(region.view(np.uint8), kernel)
    height, width = region.shape
    filled = np.pad(grown, ((0, -height % TILE_PX), (0, -width % TILE_PX)))
    by_rows = filled.reshape(-1, TILE_PX, filled.shape[1]).max(axis=1)
    tiles: Bool[ndarray, "th tw"] = by_rows.reshape(len(by_rows), -1, TILE_PX).any(axis=2)
    return tiles


class KeyframeStore:
    """Every `every`th mapped frame; the latest `window` are ready to train on, at most `buffer` are remembered.

    Beside them `long_term_keyframes` frames are ready to train on, whenever they were mapped: those that show the task's
    region, or any, for a policy that follows no task and would have fewer views otherwise. Once large images have come
    there is room for fewer (`KeyframeSettings.max_pixels`).
    """

    def __init__(self, settings: KeyframeSettings, follows_task: bool = True) -> None:
        self._settings = self._room = settings
        self._follows_task = follows_task
        self._largest_px = 1
        self._latest: list[WindowView] = []
        self._region: list[WindowView] = []
        self._buffer: list[Keyframe] = []
        self._offered = 0

    @property
    def window(self) -> tuple[WindowView, ...]:
        """What is ready to train on: the views kept for the mission that are no longer or never were among the most
        recent keyframes, and those, each oldest first.
        """
        latest = {id(view.keyframe) for view in self._latest}
        return (*(view for view in self._region if id(view.keyframe) not in latest), *self._latest)

    @property
    def buffer(self) -> tuple[Keyframe, ...]:
        """Keyframes of the whole mission, oldest first, thinned evenly once the buffer is full."""
        return tuple(self._buffer)

    def offer(self, view: WindowView) -> None:
        """Keep this mapped frame if it shows the region or it is the turn of a keyframe."""
        self._make_room_for(view.keyframe)
        due = self._offered % self._settings.every == 0
        self._offered += 1
        if self._may_stay(view):
            self._keep_for_region([*self._region, view])
        if not due:
            return
        self._latest = [*self._latest, view][-self._room.window :]
        self._buffer.append(view.keyframe)
        while len(self._buffer) > self._room.buffer:
            del self._buffer[_most_crowded(self._buffer)]

    def replace_view(self, view: WindowView) -> None:
        """Put what came to be known later in the place of a frame that is still in the window.

        A frame that turns out not to show the region stays only as one of the most recent keyframes.
        """
        revised = [view if _same_frame(old.keyframe, view.keyframe) else old for old in self._region]
        self._region = [each for each in revised if self._may_stay(each) or not each.keyframe.evaluated]
        self._latest = [view if _same_frame(old.keyframe, view.keyframe) else old for old in self._latest]
        self._buffer = [view.keyframe if _same_frame(old, view.keyframe) else old for old in self._buffer]

    def reset_roi(self) -> None:
        """The task is another one: no keyframe is evaluated, and none shows a region before it is."""
        nothing = {k.frame.depth_m.shape: RelevanceMap.empty(*k.frame.depth_m.shape) for k in self._held()}
        fresh = {
            id(old): replace(old, relevance=nothing[old.frame.depth_m.shape], evaluated=False) for old in self._held()
        }
        self._buffer = [fresh[id(keyframe)] for keyframe in self._buffer]
        views = {
            id(view.keyframe): replace(view, keyframe=fresh[id(view.keyframe)], region=_no_region(view.keyframe.frame))
            for view in self.window
        }
        self._latest = [views[id(view.keyframe)] for view in self._latest]
        self._region = [views[id(view.keyframe)] for view in self._region]

    @property
    def next_unevaluated(self) -> Keyframe | None:
        """The newest keyframe that is not evaluated; None when all are."""
        newest_first = (*(view.keyframe for view in reversed(self.window)), *reversed(self._buffer))
        return next((keyframe for keyframe in newest_first if not keyframe.evaluated), None)

    def evaluate(self, keyframe: Keyframe, view_of: Callable[[Keyframe], WindowView]) -> None:
        """Put a evaluated keyframe in its place; one that shows the region is ready to train on again."""
        self._buffer = [keyframe if _same_frame(old, keyframe) else old for old in self._buffer]
        shows_region = bool(keyframe.relevance.roi.any())
        ready = any(_same_frame(view.keyframe, keyframe) for view in self.window)
        if not ready and not shows_region:
            return
        view = view_of(keyframe)
        self.replace_view(view)
        if shows_region and not any(_same_frame(each.keyframe, keyframe) for each in self._region):
            self._keep_for_region(sorted([*self._region, view], key=_captured_ns))

    def of(self, frame: Frame) -> WindowView | None:
        """The window's view of a frame as it came; None where it is no keyframe of the window (any more)."""
        return next((view for view in self.window if view.keyframe.as_recorded is frame), None)

    @property
    def image_bytes(self) -> int:
        """Memory of all keyframes' images, without what the rasterizer prepares of those in the window."""
        return sum(array.nbytes for keyframe in self._held() for array in keyframe.state().values())

    def state(self) -> State:
        """All keyframes once, and which of them are the latest, views of the region, and the buffer."""
        held = self._held()
        places = {id(keyframe): place for place, keyframe in enumerate(held)}
        state: dict[str, NDArray[Any]] = {
            "window": int_array(*(places[id(view.keyframe)] for view in self._latest)),
            "region": int_array(*(places[id(view.keyframe)] for view in self._region)),
            "buffer": int_array(*(places[id(keyframe)] for keyframe in self._buffer)),
            "offered": int_array(self._offered),
        }
        for place, keyframe in enumerate(held):
            state |= add_prefix(str(place), keyframe.state())
        return state

    def restore(self, state: State, view_of: Callable[[Keyframe], WindowView]) -> None:
        """Take over the keyframes of another store; view_of makes one ready to train on. Raises MapFileError."""
        settings, lists = self._settings, ("window", "region", "buffer")
        latest, region, buffer = (get_counts(state, name, len(state.get(name, ()))) for name in lists)
        most = settings.window, settings.long_term_keyframes, settings.buffer
        came = len(latest), len(region), len(buffer)
        if any(count > limit for count, limit in zip(came, most, strict=True)):
            limits, counts = ("{}, {} and {}".format(*numbers) for numbers in (most, came))
            raise MapFileError(f"state keyframes ({', '.join(lists)}): expected at most {limits}, got {counts}")
        keyframes = {place: Keyframe.of(select_prefix(state, str(place))) for place in sorted({*latest, *region, *buffer})}
        views = {place: view_of(keyframes[place]) for place in sorted({*latest, *region})}
        self._latest = [views[place] for place in latest]
        self._region = [views[place] for place in region]
        self._buffer = [keyframes[place] for place in buffer]
        for keyframe in keyframes.values():
            self._make_room_for(keyframe)
        [self._offered] = get_counts(state, "offered", 1)

    def _make_room_for(self, keyframe: Keyframe) -> None:
        """The largest image that came says how many may stay from now on."""
        pixels = keyframe.frame.depth_m.size
        if pixels > self._largest_px:
            self._largest_px = pixels
            self._room = self._settings.for_images_of(pixels)

    def _may_stay(self, view: WindowView) -> bool:
        """True for a frame that may stay ready to train on beyond its turn among the latest."""
        return view.shows_region or not self._follows_task

    def _held(self) -> list[Keyframe]:
        """Every keyframe once, the buffer's first."""
        views = (*self._latest, *self._region)
        return list(dict.fromkeys([*self._buffer, *(view.keyframe for view in views)]))

    def _keep_for_region(self, views: list[WindowView]) -> None:
        """These are the views of the region, without the one that is missed least where they are too many."""
        while len(views) > self._room.long_term_keyframes:
            del views[_most_crowded([view.keyframe for view in views])]
        self._region = views


def _no_region(frame: Frame) -> Subset:
    return Subset(tiles_of(np.zeros(frame.depth_m.shape, np.bool_), margin_px=0))


def _captured_ns(view: WindowView) -> int:
    return view.keyframe.frame.capture_time_ns


def _most_crowded(keyframes: Sequence[Keyframe]) -> int:
    """The place of the keyframe that is closest in time to its neighbours; the first and the last are spared."""
    times = np.array([keyframe.frame.capture_time_ns for keyframe in keyframes])
    gaps = np.abs(times[2:] - times[:-2])  # a second recording's clock may begin anew
    return 1 + int(np.argmin(gaps)) if len(gaps) else 0


def _same_frame(a: Keyframe, b: Keyframe) -> bool:
    return a.as_recorded is b.as_recorded
