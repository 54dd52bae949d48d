"""Describe an RGB-D image by 448 bytes, and find the most similar ones of an index.

A descriptor holds a histogram of hashed ORB descriptors and thumbnails of colour and depth. It needs no vocabulary:
four hashes take six fixed bits each of an ORB descriptor.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import CodecError

Key = TypeVar("Key", bound=Hashable)

_HASHES, _BITS_PER_HASH = 4, 6
_HASHED_BITS = np.random.default_rng(0).permutation(256)[: _HASHES * _BITS_PER_HASH].reshape(_HASHES, _BITS_PER_HASH)
_MAX_FEATURES = 300
_FAST_THRESHOLD = 7
_COUNT_STEP = 1 / 12
"""Of the root of a count; 300 features in one bin stay below 255."""
_COLUMNS, _ROWS = 8, 6
_SIZES = {"features": _HASHES << _BITS_PER_HASH, "colour": 3 * _COLUMNS * _ROWS, "depth": _COLUMNS * _ROWS}
DESCRIPTOR_BYTES = sum(_SIZES.values())
_WEIGHTS = {"features": 1.0, "colour": 0.5, "depth": 0.25}
"""Chosen on 63 frames of the kitchen of 7-Scenes: a near keyframe is among the first five for 93 %."""
_NEAREST_M, _LOG_DEPTH_STEP = 0.1, 0.025
_MIN_MEASURED = 0.2
_MIN_CONTRAST = 4.0
"""Standard deviation of a thumbnail's values, of 255, below which it counts as noise."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceDescriptor:
    """What an image shows: counts of hashed features, thumbnails of Lab colour and of log depth. Raises ShapeError."""

    values: UInt8[ndarray, "448"]

    def __post_init__(self) -> None:
        require_array("place descriptor", self.values, (DESCRIPTOR_BYTES,), np.uint8)

    def encode(self) -> bytes:
        """Return the descriptor as bytes."""
        return self.values.tobytes()

    @classmethod
    def decode(cls, data: bytes) -> PlaceDescriptor:
        """Return the descriptor of these bytes. Raises CodecError for another length."""
        if len(data) != DESCRIPTOR_BYTES:
            raise CodecError(f"place descriptor: expected {DESCRIPTOR_BYTES} bytes, got {len(data)}")
        return cls(np.frombuffer(data, np.uint8).copy())

    def similarity(self, other: PlaceDescriptor) -> float:
        """Return the similarity to another descriptor, at most 1."""
        return float(_unit_vector(self) @ _unit_vector(other))


def describe(rgb: UInt8[ndarray, "h w 3"], depth_m: Float32[ndarray, "h w"]) -> PlaceDescriptor:
    """Return the descriptor of an image; depth 0 means no measurement."""
    require_array("place depth_m", depth_m, rgb.shape[:2], np.float32)
    parts = (_feature_counts(rgb), _colour_thumbnail(rgb), _depth_thumbnail(depth_m))
    return PlaceDescriptor(np.concatenate([part.ravel() for part in parts]))


def _feature_counts(rgb: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "256"]:
    """Return the roots of the counts of each hash value."""
    orb = cv2.ORB.create(nfeatures=_MAX_FEATURES, nlevels=4, fastThreshold=_FAST_THRESHOLD)
    _, descriptors = orb.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    bits = np.unpackbits(np.zeros((0, 32), np.uint8) if descriptors is None else descriptors.astype(np.uint8), axis=1)
    powers = 1 << np.arange(_BITS_PER_HASH)
    counts = [
        np.bincount(bits[:, hashed].astype(np.int64) @ powers, minlength=1 << _BITS_PER_HASH) for hashed in _HASHED_BITS
    ]
    return np.minimum(np.sqrt(np.concatenate(counts)) / _COUNT_STEP, 255.0).astype(np.uint8)


def _colour_thumbnail(rgb: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "6 8 3"]:
    small = cv2.resize(rgb, (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_RGB2LAB)


def _depth_thumbnail(depth_m: Float32[ndarray, "h w"]) -> UInt8[ndarray, "6 8"]:
    """Return the mean log depth of each cell; 0 where few pixels have a depth."""
    measured = depth_m > _NEAREST_M
    logs = np.zeros_like(depth_m)
    np.log(depth_m / np.float32(_NEAREST_M), out=logs, where=measured)
    sums, shares = (
        cv2.resize(image.astype(np.float32), (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA)
        for image in (logs, measured)
    )
    steps = 1.0 + sums / np.maximum(shares, _MIN_MEASURED) / _LOG_DEPTH_STEP
    return np.where(shares >= _MIN_MEASURED, np.clip(steps, 1.0, 255.0), 0.0).astype(np.uint8)


def _unit_vector(descriptor: PlaceDescriptor) -> Float32[ndarray, "448"]:
    """Return a vector of length 1 whose product with another is their similarity."""
    values = descriptor.values.astype(np.float32)
    features, colour, depth = np.split(values, np.cumsum(list(_SIZES.values()))[:-1])
    lab = colour.reshape(-1, 3) - colour.reshape(-1, 3).mean(axis=0)
    measured = depth > 0
    relative = (
        np.where(measured, depth - depth[measured].mean(), np.float32(0)) if measured.any() else np.zeros_like(depth)
    )
    weighted = [
        np.float32(weight) * part / max(float(np.linalg.norm(part)), _MIN_CONTRAST * len(part) ** 0.5)
        for part, weight in zip((features, lab.ravel(), relative), _WEIGHTS.values(), strict=True)
    ]
    vector = np.concatenate(weighted)
    return vector / max(float(np.linalg.norm(vector)), 1e-6)


class PlaceIndex(Generic[Key]):
    """Descriptors by key, in order of addition. Not thread-safe."""

    def __init__(self) -> None:
        self._keys: list[Key] = []
        self._vectors = np.zeros((16, DESCRIPTOR_BYTES), np.float32)

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, key: Key, descriptor: PlaceDescriptor) -> None:
        """Add a descriptor."""
        if len(self._keys) == len(self._vectors):
            self._vectors = np.concatenate([self._vectors, np.zeros_like(self._vectors)])
        self._vectors[len(self._keys)] = _unit_vector(descriptor)
        self._keys.append(key)

    def candidates(self, descriptor: PlaceDescriptor, limit: int) -> list[tuple[Key, float]]:
        """Return up to `limit` keys with their similarities, the most similar first; of equal ones the earliest."""
        scores = self._vectors[: len(self._keys)] @ _unit_vector(descriptor)
        order = np.argsort(-scores, kind="stable")[:limit]
        return [(self._keys[i], float(scores[i])) for i in order]
