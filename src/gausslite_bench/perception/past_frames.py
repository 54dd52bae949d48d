"""Masks of past frames, completed whenever an object becomes known, as the mapper completes its keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.perception.relevance import RelevanceEstimator


@dataclass(frozen=True, slots=True, eq=False)
class _PastFrame:
    """A frame with its mask and the masks of its objects, one bit a pixel."""

    frame: Frame
    mask: UInt8[ndarray, " n"]
    known_objects: int
    objects: Mapping[str, UInt8[ndarray, " n"]]


class PastFrames:
    """Every frame of a run with its mask; a mission completes only the keyframes that it keeps."""

    def __init__(self, estimator: RelevanceEstimator) -> None:
        self._estimator = estimator
        self._frames: list[_PastFrame] = []

    def add(self, frame: Frame, relevance: RelevanceMap, objects: Mapping[str, Bool[ndarray, "h w"]]) -> None:
        """Add a frame with the pixels of the objects that it shows; complete the frames before it."""
        packed = {name: np.packbits(pixels) for name, pixels in objects.items()}
        self._frames.append(_PastFrame(frame, np.packbits(relevance.roi), relevance.known_objects, packed))
        self._frames = [self._completed(past) for past in self._frames]

    def masks(self) -> Iterator[tuple[Frame, Bool[ndarray, "h w"], dict[str, Bool[ndarray, "h w"]]]]:
        """Yield each frame with its mask and the pixels of its objects."""
        for past in self._frames:
            objects = {name: _unpacked(bits, past.frame) for name, bits in past.objects.items()}
            yield past.frame, _unpacked(past.mask, past.frame), objects

    def _completed(self, past: _PastFrame) -> _PastFrame:
        if past.known_objects >= self._estimator.known_objects:
            return past
        roi = _unpacked(past.mask, past.frame)
        known = RelevanceMap(roi.astype(np.float32), np.where(roi, 0, NO_TARGET).astype(np.int16), past.known_objects)
        completed = self._estimator.complete(past.frame, known)
        return replace(past, mask=np.packbits(completed.roi), known_objects=completed.known_objects)


def _unpacked(bits: UInt8[ndarray, " n"], frame: Frame) -> Bool[ndarray, "h w"]:
    shape = frame.depth_m.shape
    return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(np.bool_)
