"""Keep the reduced depth of a run's keyframes, which show what has changed at the next visit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.errors import MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.free_space import DepthView
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mission.task_mapper import FrameOutcome

_DEPTH_FILE, _M_PER_UNIT = "keyframe_depth.safetensors", np.float32(0.001)


def write_keyframe_depths(folder: Path, depths_m: Mapping[int, Float32[ndarray, "h w"]]) -> None:
    """Write reduced depth images by the index of their keyframe, to a millimetre and 32 m. Raises StorageError."""
    units = {str(index): depth_m / _M_PER_UNIT + 0.5 for index, depth_m in depths_m.items()}
    largest = np.iinfo(np.int16).max
    write_state(folder / _DEPTH_FILE, {i: np.minimum(image, largest).astype(np.int16) for i, image in units.items()})


def read_keyframe_depths(folder: Path) -> dict[int, Float32[ndarray, "h w"]]:
    """Return the depth images of `write_keyframe_depths`; empty without them. Raises MapFileError."""
    path = folder / _DEPTH_FILE
    if not path.exists():
        return {}
    state = read_state(path)
    if not all(name.isdecimal() and image.ndim == 2 and image.dtype == np.int16 for name, image in state.items()):
        raise MapFileError(f"{path}: expected depth images by the index of their keyframe, got other arrays")
    return {int(name): image.astype(np.float32) * _M_PER_UNIT for name, image in state.items()}


_MAX_DEPTH_IMAGES = 400
"""With 160 x 120 pixels, 15 MB of a run."""


class DepthRecord:
    """Writes the reduced depth of a run's keyframes."""

    def add(self, _outcome: FrameOutcome, _poses: PoseTable, _parts: Callable[[], Iterable[Gaussians]]) -> None:
        """Take nothing of a frame: keyframes have the depth."""

    def write(self, folder: Path, keyframes: Sequence[Keyframe]) -> None:
        """Write the depth of at most 400 keyframes, evenly chosen. Raises StorageError."""
        frames = [keyframe.frame for keyframe in keyframes[:: -(-len(keyframes) // _MAX_DEPTH_IMAGES) or 1]]
        write_keyframe_depths(folder, {frame.index: DepthView.reduced(frame).depth_m for frame in frames})
