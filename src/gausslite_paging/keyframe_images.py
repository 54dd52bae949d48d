"""Keep the images of keyframes that do not train in files that end with the keyframes; reads go through the system."""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any
from weakref import ref

import numpy as np
from numpy.typing import NDArray

from gausslite.mapping.keyframes import Keyframe

_LEAST_BYTES = 1 << 12
"""Smaller arrays stay in memory."""
_ALIGNED_BYTES = 64


class KeyframeImages:
    """Owns no image: a file lasts as long as an array of it."""

    def __init__(self) -> None:
        self._files: list[tuple[ref[mmap.mmap], int]] = []

    @property
    def size(self) -> int:
        """Bytes of all images in files."""
        self._files = [(memory, size) for memory, size in self._files if memory() is not None]
        return sum(size for _, size in self._files)

    def keep(self, keyframe: Keyframe, free_bytes: int) -> Keyframe:
        """Return the keyframe with its images in a file; the keyframe itself if there is no room for them."""
        arrays = {
            id(array): array for array in _arrays(keyframe) if array.nbytes >= _LEAST_BYTES and not _is_in_file(array)
        }
        starts, end = {}, 0
        for name, array in arrays.items():
            starts[name] = end
            end += -(-array.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        if not arrays or end > free_bytes:
            return keyframe
        try:
            with tempfile.TemporaryFile(prefix="gausslite-") as file:
                file.truncate(end)
                for name, array in arrays.items():
                    file.seek(starts[name])
                    file.write(np.ascontiguousarray(array).data)
                file.flush()
                memory = mmap.mmap(file.fileno(), end, access=mmap.ACCESS_COPY)
        except OSError:
            return keyframe
        placed = {
            name: np.frombuffer(memory, array.dtype, array.size, starts[name]).reshape(array.shape)
            for name, array in arrays.items()
        }
        self._files.append((ref(memory), end))
        kept: Keyframe = _replaced(keyframe, placed)
        # its checks have read the images
        memory.madvise(mmap.MADV_DONTNEED)
        return kept


def _is_in_file(array: NDArray[Any]) -> bool:
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(base, mmap.mmap | memoryview)


def _arrays(value: object) -> Iterator[NDArray[Any]]:
    """Yield all arrays of a value and of its fields."""
    if isinstance(value, np.ndarray):
        yield value
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _arrays(getattr(value, field.name))


def _replaced(value: Any, placed: dict[int, NDArray[Any]]) -> Any:
    """Return the value with these arrays, named by the id of those that they replace."""
    if isinstance(value, np.ndarray):
        return placed.get(id(value), value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    own = {field.name: getattr(value, field.name) for field in fields(value)}
    changed = {name: new for name, old in own.items() if (new := _replaced(old, placed)) is not old}
    return replace(value, **changed) if changed else value
