"""Objects that a person points at; a plug-in of `gausslite.pointing` grows them from clicks, boxes and points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import PointedObject, PointM, Region
from gausslite.plugins import Group, load

PointedMask = tuple[str, Bool[ndarray, "h w"], Frame]
"""Noun, mask and frame of an object pointed at."""


class Pointing(Protocol):
    """What a package registers in `gausslite.pointing`: an object or a module with the functions below."""

    def region_on_image(
        self,
        frame: Frame,
        points_px: Sequence[tuple[float, float]] = (),
        boxes_px: Sequence[tuple[float, float, float, float]] = (),
    ) -> Region:
        """Return the region of points (x, y) and boxes (left, top, right, bottom) on one frame, as one object."""

    def region_at(self, point_m: PointM, frames: Iterable[Frame]) -> Region:
        """Return the object at a point in the world, on the frame that shows the point best."""

    def pointed_masks(self, pointed: Iterable[PointedObject], keyframes: Sequence[Frame]) -> list[PointedMask]:
        """Return the mask of each object pointed at; keyframes: oldest first."""


def pointing() -> Pointing:
    """Return the installed plug-in. Raises MissingPluginError; its functions raise InvalidInputError."""
    plugin: Pointing = load(Group.POINTING, purpose="pointing at objects")
    return plugin


def pointed_masks(pointed: Sequence[PointedObject], keyframes: Sequence[Frame]) -> list[PointedMask]:
    """Return the mask of each object pointed at on a keyframe. Raises MissingPluginError, InvalidInputError."""
    return pointing().pointed_masks(pointed, keyframes) if pointed else []
