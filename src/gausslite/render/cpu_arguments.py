"""What steps of the native backend are told: checked and carried over to the kernels once, not in every step."""

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
from gausslite.errors import InvalidInputError
from gausslite.render.checks import require_marks, require_scene, require_tables
from gausslite.render.cpu_kernels import load_kernels
from gausslite.render.rasterizer import AdamSettings, LossWeights, Subset, UpdateCounter

if TYPE_CHECKING:
    from gausslite.render import _kernels

_Table: TypeAlias = Float32[ndarray, "n 16"]
_Tables: TypeAlias = tuple[_Table, _Table, _Table]
_Native = TypeVar("_Native")


@dataclass(frozen=True, slots=True, eq=False)
class _Carried(Generic[_Native]):
    """Arguments as the kernels hold them: checked and carried over once for as long as the very same ones come.

    Between two steps the interpreter's own work is slow, because the kernels have had the caches to themselves.
    """

    asked: tuple[object, ...]
    native: _Native

    def is_of(self, asked: tuple[object, ...]) -> bool:
        """True when these are the same objects; what their arrays hold may have changed."""
        return all(map(is_, self.asked, asked))


@dataclass(frozen=True, slots=True, eq=False)
class CpuView:
    """A training image inside the native backend, with what the latest step of each phase looked at of it."""

    camera: Camera
    intrinsics: tuple[float, float, float, float, int, int]
    native: _kernels.View
    scenes: dict[bool, _Carried[_kernels.StepScene]] = field(default_factory=dict, repr=False)

    def scene(
        self, n: int, T_camera_world: Float64[ndarray, "4 4"], subset: Subset, masked: bool
    ) -> _kernels.StepScene:
        """What a step with n rows looks at. Raises ShapeError, InvalidInputError for ids that are not ascending."""
        asked, known = (T_camera_world, subset), self.scenes.get(masked)
        if known is not None and known.is_of(asked):
            return known.native
        require_scene(n, self.camera, T_camera_world, subset)
        arrays = T_camera_world, subset.tiles, subset.ids
        handed = contiguous(T_camera_world), contiguous(subset.tiles), contiguous(subset.ids)
        native: _kernels.StepScene = load_kernels().StepScene(self.native, self.intrinsics, *handed)
        # a copy would not follow its array, and whether ids are rows depends on more than the ids
        if subset.ids is None and all(map(is_, arrays, handed)):
            self.scenes[masked] = _Carried(asked, native)
        return native


class Loans:
    """The tables on loan to the kernels, and what steps on them are told beside the view; one loan at a time."""

    def __init__(self) -> None:
        self._held: _Tables | None = None
        self._number = 0
        self._trainings: dict[bool, _Carried[_kernels.StepTraining]] = {}

    @contextmanager
    def lend(self, tables: _Tables) -> Iterator[None]:
        """Until this ends, the tables change by steps alone. Raises ShapeError, InvalidInputError for a second loan."""
        require_tables(*tables)
        if self._held is not None:
            raise InvalidInputError("bind_tables: expected no other tables on loan, got a second loan")
        self._number += 1
        self._held = tables
        try:
            yield
        finally:
            self._held = None
            self._trainings.clear()

    def training(
        self,
        tables: _Tables,
        rules: tuple[LossWeights, AdamSettings],
        masked: bool,
        trainable: Bool[ndarray, " n"] | None,
        update_counter: UpdateCounter | None,
    ) -> _kernels.StepTraining:
        """What a step changes and how; kept for the next step on the same loan. Raises ShapeError."""
        asked, known = (*tables, *rules, trainable, update_counter), self._trainings.get(masked)
        if known is not None and known.is_of(asked):
            return known.native
        on_loan = self._held is not None and all(map(is_, tables, self._held))
        if not on_loan:
            require_tables(*tables)
        require_marks(len(tables[0]), trainable, update_counter)
        (loss, adam), mask = rules, None if update_counter is None else update_counter.mask
        marks = contiguous(trainable), None if update_counter is None else update_counter.counts, contiguous(mask)
        native: _kernels.StepTraining = load_kernels().StepTraining(
            tables,
            (loss.colour, loss.depth, loss.ssim, loss.normalise_by_image),
            _row_rates(adam),
            (adam.beta1, adam.beta2, adam.epsilon, adam.decay_after_updates),
            masked,
            *marks,
            self._number if on_loan else 0,
        )
        if on_loan and marks[0] is trainable and marks[2] is mask:
            self._trainings[masked] = _Carried(asked, native)
        return native


@lru_cache(maxsize=8)
def _row_rates(adam: AdamSettings) -> tuple[float, ...]:
    return tuple(adam.row_rates().tolist())


def intrinsics(camera: Camera) -> tuple[float, float, float, float, int, int]:
    """fx, fy, cx, cy, width and height, as the kernels take them."""
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px


def contiguous(array: ndarray | None) -> ndarray | None:
    """The array itself where the kernels can read it as it lies, else a copy."""
    return None if array is None else np.ascontiguousarray(array)
