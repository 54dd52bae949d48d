"""Convert the arguments of native training steps, and cache them while the same objects are passed again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from operator import is_
from typing import TYPE_CHECKING, Generic, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.errors import InvalidInputError
from gausslite.render.checks import require_row_masks, require_scene, require_tables
from gausslite.render.cpu_kernels import load_kernels
from gausslite.render.rasterizer import AdamSettings, LossWeights, Subset, UpdateCounter

if TYPE_CHECKING:
    from gausslite.render import _kernels

_Table: TypeAlias = Float32[ndarray, "n 16"]
_Tables: TypeAlias = tuple[_Table, _Table, _Table]
_Native = TypeVar("_Native")


@dataclass(frozen=True, slots=True, eq=False)
class _CachedArguments(Generic[_Native]):
    """Python arguments and their checked native form.

    Checks cost time between two steps: the kernels have evicted the interpreter's data from the CPU caches.
    """

    arguments: tuple[object, ...]
    native: _Native

    def matches(self, arguments: tuple[object, ...]) -> bool:
        """Return True if these are the same objects; the values of their arrays may have changed."""
        return all(map(is_, self.arguments, arguments))


@dataclass(frozen=True, slots=True, eq=False)
class CpuView:
    """A training image in the kernels' layout, with the cached scene of the latest masked and unmasked step."""

    camera: Camera
    intrinsics: tuple[float, float, float, float, int, int]
    motion: list[float] | None
    native: _kernels.View
    scenes: dict[bool, _CachedArguments[_kernels.StepScene]] = field(default_factory=dict, repr=False)

    def scene(
        self, n: int, T_camera_world: Float64[ndarray, "4 4"], subset: Subset, masked: bool
    ) -> _kernels.StepScene:
        """Return view, pose and subset in native form, for n rows. Raises ShapeError, InvalidInputError."""
        arguments, cached = (T_camera_world, subset), self.scenes.get(masked)
        if cached is not None and cached.matches(arguments):
            return cached.native
        require_scene(n, self.camera, T_camera_world, subset)
        arrays = T_camera_world, subset.tiles, subset.ids
        passed = contiguous(T_camera_world), contiguous(subset.tiles), contiguous(subset.ids)
        native: _kernels.StepScene = load_kernels().StepScene(self.native, self.intrinsics, *passed, self.motion)
        # a copy would not follow later changes of its array; the check of ids depends on n
        if subset.ids is None and all(map(is_, arrays, passed)):
            self.scenes[masked] = _CachedArguments(arguments, native)
        return native


class TableBinding:
    """The bound tables, at most one set at a time, and the cached training arguments of steps on them."""

    def __init__(self) -> None:
        self._tables: _Tables | None = None
        self._binding_id = 0
        self._trainings: dict[bool, _CachedArguments[_kernels.StepTraining]] = {}

    @contextmanager
    def bind(self, tables: _Tables) -> Iterator[None]:
        """Bind the tables inside this context. Raises ShapeError, InvalidInputError if tables are bound already."""
        require_tables(*tables)
        if self._tables is not None:
            raise InvalidInputError("bind_tables: expected no bound tables, got a second binding")
        self._binding_id += 1
        self._tables = tables
        try:
            yield
        finally:
            self._tables = None
            self._trainings.clear()

    def training(
        self,
        tables: _Tables,
        settings: tuple[LossWeights, AdamSettings],
        masked: bool,
        trainable: Bool[ndarray, " n"] | None,
        update_counter: UpdateCounter | None,
    ) -> _kernels.StepTraining:
        """Return the native form of tables, settings, masks and counter. Raises ShapeError."""
        arguments, cached = (*tables, *settings, trainable, update_counter), self._trainings.get(masked)
        if cached is not None and cached.matches(arguments):
            return cached.native
        is_bound = self._tables is not None and all(map(is_, tables, self._tables))
        if not is_bound:
            require_tables(*tables)
        require_row_masks(len(tables[0]), trainable, update_counter)
        loss, adam = settings
        counts = None if update_counter is None else update_counter.counts
        mask = None if update_counter is None else update_counter.mask
        flags, mask_flags = contiguous(trainable), contiguous(mask)
        native: _kernels.StepTraining = load_kernels().StepTraining(
            tables=tables,
            loss=(loss.colour, loss.depth, loss.ssim, loss.normalise_by_image),
            rates=_row_rates(adam),
            adam=(adam.beta1, adam.beta2, adam.epsilon, adam.decay_after_updates),
            masked=masked,
            trainable=flags,
            update_counts=counts,
            count_mask=mask_flags,
            binding_id=self._binding_id if is_bound else 0,
        )
        if is_bound and flags is trainable and mask_flags is mask:
            self._trainings[masked] = _CachedArguments(arguments, native)
        return native


@lru_cache(maxsize=8)
def _row_rates(adam: AdamSettings) -> tuple[float, ...]:
    return tuple(adam.row_rates().tolist())


def intrinsics(camera: Camera) -> tuple[float, float, float, float, int, int]:
    """Return fx, fy, cx, cy, width and height in pixels."""
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px


def native_motion(motion: CameraMotion | None) -> list[float] | None:
    """Return linear and angular velocity, readout and exposure time; None for a camera at rest."""
    if motion is None or motion.is_still:
        return None
    velocities = motion.twist.linear_m_s.tolist() + motion.twist.angular_rad_s.tolist()
    return [*velocities, motion.readout_s, motion.exposure_s]


def contiguous(array: ndarray | None) -> ndarray | None:
    """Return the array itself if it is contiguous, else a contiguous copy."""
    return None if array is None else np.ascontiguousarray(array)
