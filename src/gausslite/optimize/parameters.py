"""Hold the trainable Gaussians and their optimiser state in memory that is allocated once and never outgrown."""

from __future__ import annotations

import math
import mmap
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int16, Int64, UInt32
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.arrays import require_array, require_finite
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State, get_array
from gausslite.errors import InvalidInputError, MapFileError, QuotaError
from gausslite.render.rasterizer import GRAD_2D_SUM, LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, RGB, ROW_WIDTH, UPDATE_COUNT

_COLUMNS: dict[str, tuple[int | None, type[np.generic]]] = {
    "rows": (ROW_WIDTH, np.float32),
    "first_moment": (ROW_WIDTH, np.float32),
    "second_moment": (ROW_WIDTH, np.float32),
    "ema_rows": (ROW_WIDTH, np.float32),
    "active": (None, np.bool_),
    "kappa": (None, np.uint32),
    "target": (None, np.int16),
    "roi_evidence": (None, np.int16),
}
_MIN_SCALE_M = 1e-7
_MAX_LOG_SCALE = 80.0
"""Beyond it the scale is not a float32."""
_MOST_PER_SECOND, _ROUNDING = 1e6, 1e-30
"""By Cauchy and Schwarz a first moment's square is at most (1 - b1)^2 / ((1 - b2) (1 - b1^2 / b2)) times the second: 53
for Adam's usual betas. This leaves room for others, and for what float32 rounds to 0."""
_MIN_OPACITY = 1e-6
_ROWS_IN_CACHE = 4096
_SHORTEST_LIFE = 8.0
"""A row's mean reaches as far as is asked once it has had so many times as many updates."""


class SplatTable:
    """Rows of raw parameters, their running means, Adam's two moments and what each Gaussian carries (Sec. III-A).

    `capacity` is the hard cap: `count` never exceeds it, not even for an instant. All arrays are views of the first
    `count` rows; a view taken before `append`, `append_rows` or `keep` is stale after it.
    """

    def __init__(self, capacity: int) -> None:
        """Reserve room for `capacity` Gaussians. Raises InvalidInputError below 1 and beyond memory."""
        if capacity < 1:
            raise InvalidInputError(f"table capacity: expected at least 1 Gaussian, got {capacity}")
        self._capacity = capacity
        self._count = 0
        try:
            self._rows, self._first_moment, self._second_moment = (_row_memory(capacity) for _ in range(3))
            self._mean_rows = _row_memory(capacity)
            self._active = np.zeros(capacity, np.bool_)
            self._kappa = np.zeros(capacity, np.uint32)
            self._target = np.zeros(capacity, np.int16)
            self._roi_evidence = np.zeros(capacity, np.int16)
        except (OSError, MemoryError, OverflowError, ValueError):
            raise InvalidInputError(
                f"max_gaussians: expected as many as there is memory for, 270 bytes each, got {capacity}"
            ) from None

    def __len__(self) -> int:
        return self._count

    @property
    def capacity(self) -> int:
        """The most Gaussians this table can ever hold."""
        return self._capacity

    @property
    def count(self) -> int:
        """Gaussians held now."""
        return self._count

    @property
    def free_slots(self) -> int:
        """How many Gaussians still fit."""
        return self._capacity - self._count

    @property
    def table_bytes(self) -> int:
        """Memory reserved for the Gaussians and what each carries."""
        beside = (self._active, self._kappa, self._target, self._roi_evidence)
        return self._rows.nbytes + self._mean_rows.nbytes + sum(column.nbytes for column in beside)

    @property
    def optimizer_bytes(self) -> int:
        """Memory reserved for Adam's two moments."""
        return self._first_moment.nbytes + self._second_moment.nbytes

    @property
    def rows(self) -> Float32[ndarray, "n 16"]:
        """Raw parameters, laid out as in `render.rasterizer`."""
        return self._rows[: self._count]

    @property
    def first_moment(self) -> Float32[ndarray, "n 16"]:
        """Adam's first moment; its columns 14 and 15 hold the density statistics."""
        return self._first_moment[: self._count]

    @property
    def second_moment(self) -> Float32[ndarray, "n 16"]:
        """Adam's second moment."""
        return self._second_moment[: self._count]

    @property
    def ema_rows(self) -> Float32[ndarray, "n 16"]:
        """The rows' running means, as far as `average` carried them on; a newborn's is its row."""
        return self._mean_rows[: self._count]

    @property
    def active(self) -> Bool[ndarray, " n"]:
        """The paper's a: seeded inside the task's region, or found there when the task changed."""
        return self._active[: self._count]

    @property
    def kappa(self) -> UInt32[ndarray, " n"]:
        """Active-phase iterations that trained each Gaussian."""
        return self._kappa[: self._count]

    @property
    def target(self) -> Int16[ndarray, " n"]:
        """Index into TaskGraph.targets, -1 for none."""
        return self._target[: self._count]

    @property
    def roi_evidence(self) -> Int16[ndarray, " n"]:
        """Views that show each Gaussian inside the present task's region, less those that show it outside.

        A newborn has the vote of the view it was seeded from, or of its parent.
        """
        return self._roi_evidence[: self._count]

    @property
    def means_m(self) -> Float32[ndarray, "n 3"]:
        """Means in metres."""
        return self.rows[:, MEAN]

    @property
    def opacities(self) -> Float32[ndarray, " n"]:
        """Opacities in (0, 1)."""
        return _sigmoid(self.rows[:, OPACITY_LOGIT])

    def has_lower_opacity(self, opacity: float) -> Bool[ndarray, " n"]:
        """Return True for each Gaussian of lower opacity than this one in (0, 1)."""
        return self.rows[:, OPACITY_LOGIT] < math.log(opacity) - math.log1p(-opacity)

    def most_transparent(self, ids: Int64[ndarray, " m"], count: int) -> Int64[ndarray, " k"]:
        """Return up to `count` of these ascending ids, those of lowest opacity; of equal ones the lower ids."""
        if count >= len(ids):
            return ids
        if count <= 0:
            return ids[:0]
        # logits separate opacities that are equal in float32
        logits = self.rows[ids, OPACITY_LOGIT]
        limit = np.partition(logits, count - 1)[count - 1]
        below, equal = np.flatnonzero(logits < limit), np.flatnonzero(logits == limit)
        chosen: Int64[ndarray, " k"] = ids[np.concatenate([below, equal[: count - len(below)]])]
        return chosen

    def make_isotropic(self) -> None:
        """Set the three scales of each Gaussian to their geometric mean."""
        log_scales = self.rows[:, LOG_SCALE]
        log_scales[:] = log_scales.mean(axis=1, keepdims=True)

    def clip_colours(self, lowest: float, highest: float) -> None:
        """Clip all colour channels to this range."""
        # one channel at a time: NumPy takes twice as long for three columns at once
        for channel in self.rows[:, RGB].T:
            np.clip(channel, lowest, highest, out=channel)

    def append(self, gaussians: Gaussians) -> None:
        """Add Gaussians with fresh optimiser state. Raises QuotaError when they do not fit."""
        self.append_rows(gaussians_to_rows(gaussians), gaussians.active, gaussians.kappa, gaussians.target)

    def append_rows(
        self,
        rows: Float32[ndarray, "m 16"],
        active: Bool[ndarray, " m"],
        kappa: UInt32[ndarray, " m"],
        target: Int16[ndarray, " m"],
    ) -> None:
        """Add raw rows with fresh optimiser state. Raises QuotaError when they do not fit."""
        if len(rows) > self.free_slots:
            raise QuotaError(f"table: expected at most {self.free_slots} more Gaussians, got {len(rows)}")
        self._put(slice(self._count, self._count + len(rows)), rows, active, kappa, target)
        self._count += len(rows)

    def replace(self, ids: Int[ndarray, " m"], gaussians: Gaussians) -> None:
        """Put these Gaussians, with fresh optimiser state, in the rows of others."""
        self._put(ids, gaussians_to_rows(gaussians), gaussians.active, gaussians.kappa, gaussians.target)

    def keep(self, mask: Bool[ndarray, " n"]) -> None:
        """Drop the Gaussians where mask is false; the others keep their optimiser state.

        The last ones, in their order, take the rows of those that leave, so that no more rows move than fall vacant.
        """
        require_array("keep mask", mask, (self._count,), np.bool_)
        kept = int(np.count_nonzero(mask))
        vacant, moved = np.flatnonzero(~mask[:kept]), kept + np.flatnonzero(mask[kept:])
        for name in _COLUMNS:
            column = getattr(self, f"_{name}")
            column[vacant] = column[moved]
        self._count = kept

    def state(self) -> State:
        """Everything the table holds, as views of it."""
        return {name: getattr(self, name) for name in _COLUMNS}

    def restore(self, state: State) -> None:
        """Take over another table's contents. Raises QuotaError when they do not fit, MapFileError, ShapeError."""
        rows = get_array(state, "rows", (None, ROW_WIDTH), np.float32)
        if len(rows) > self._capacity:
            raise QuotaError(f"max_gaussians: expected at least the {len(rows)} saved ones, got {self._capacity}")
        columns = {
            name: get_array(state, name, (len(rows),) if width is None else (len(rows), width), dtype)
            for name, (width, dtype) in _COLUMNS.items()
        }
        for name in ("rows", "first_moment", "second_moment", "ema_rows"):
            require_finite(f"state {name}", columns[name])
        ema_rows = columns["ema_rows"]
        too_large = max(values[:, LOG_SCALE].max(initial=-np.inf) for values in (rows, ema_rows)) > _MAX_LOG_SCALE
        unborn = (ema_rows[:, UPDATE_COUNT] < 0).any() or (ema_rows[:, UPDATE_COUNT] > rows[:, UPDATE_COUNT]).any()
        if too_large or unborn or not _belong_together(*_moments(columns)):
            raise MapFileError("state table: expected scales, means and moments that training can reach, got others")
        for name, column in columns.items():
            getattr(self, f"_{name}")[: len(rows)] = column
        self._count = len(rows)

    def update_ema(self, horizon: float) -> None:
        """Carry on the mean of each row over about its last `horizon` updates, and at most an eighth of all it had: a
        row that is still on its way must not be held back by where it was.
        """
        all_moved = np.flatnonzero(self.rows[:, UPDATE_COUNT] != self.ema_rows[:, UPDATE_COUNT])
        for start in range(0, len(all_moved), _ROWS_IN_CACHE):
            moved = all_moved[start : start + _ROWS_IN_CACHE]
            rows, mean = self.rows.take(moved, axis=0), self.ema_rows.take(moved, axis=0)
            reach = np.minimum(np.float32(horizon), rows[:, UPDATE_COUNT] / _SHORTEST_LIFE)
            share = -np.expm1((mean[:, UPDATE_COUNT] - rows[:, UPDATE_COUNT]) / reach)
            mean += share[:, None] * (rows - mean)
            mean[:, UPDATE_COUNT] = rows[:, UPDATE_COUNT]
            self.ema_rows[moved] = mean

    def to_gaussians(self, ids: Int[ndarray, " m"] | None = None, use_ema: bool = False) -> Gaussians:
        """Copies of all Gaussians, or of these rows, as physical values; their running means where asked."""
        chosen = np.arange(self._count) if ids is None else ids
        columns = self.ema_rows if use_ema else self.rows, self.active, self.kappa, self.target
        return rows_to_gaussians(*(column.take(chosen, axis=0) for column in columns))

    def _put(
        self,
        place: slice | Int[ndarray, " m"],
        rows: Float32[ndarray, "m 16"],
        active: Bool[ndarray, " m"],
        kappa: UInt32[ndarray, " m"],
        target: Int16[ndarray, " m"],
    ) -> None:
        """A newborn's optimiser state is empty, its vote its view's."""
        self._rows[place] = rows
        self._mean_rows[place] = rows
        self._first_moment[place] = 0.0
        self._second_moment[place] = 0.0
        self._active[place], self._kappa[place], self._target[place] = active, kappa, target
        self._roi_evidence[place] = np.where(active, 1, -1)


def _moments(columns: State) -> tuple[NDArray[Any], NDArray[Any]]:
    return columns["first_moment"][:, :GRAD_2D_SUM], columns["second_moment"][:, :GRAD_2D_SUM]


def _belong_together(first: Float32[ndarray, "n 14"], second: Float32[ndarray, "n 14"]) -> bool:
    """False for a first moment so large beside the second that one step would throw the Gaussian away."""
    allowed = _MOST_PER_SECOND * second.astype(np.float64) + _ROUNDING
    return bool((second >= 0).all() and (np.square(first.astype(np.float64)) <= allowed).all())


def gaussians_to_rows(gaussians: Gaussians) -> Float32[ndarray, "n 16"]:
    """Physical values to raw rows: scales to logarithms, opacities to logits."""
    opacities = np.clip(gaussians.opacities, _MIN_OPACITY, 1.0 - _MIN_OPACITY).astype(np.float32)
    rows = np.zeros((len(gaussians), ROW_WIDTH), np.float32)
    rows[:, MEAN] = gaussians.means_m
    rows[:, LOG_SCALE] = np.log(np.maximum(gaussians.scales_m, _MIN_SCALE_M))
    rows[:, QUAT] = gaussians.quats_wxyz
    rows[:, OPACITY_LOGIT] = np.log(opacities) - np.log1p(-opacities)
    rows[:, RGB] = gaussians.rgb
    return rows


def rows_to_gaussians(
    rows: Float32[ndarray, "n 16"],
    active: Bool[ndarray, " n"],
    kappa: UInt32[ndarray, " n"],
    target: Int16[ndarray, " n"],
) -> Gaussians:
    """Raw rows to physical values, with quaternions of unit length."""
    quats = rows[:, QUAT]
    length = np.sqrt(np.einsum("ij,ij->i", quats, quats))[:, None]
    return Gaussians(
        means_m=rows[:, MEAN].copy(),
        quats_wxyz=quats / np.maximum(length, np.float32(1e-12)),
        scales_m=np.exp(rows[:, LOG_SCALE]),
        opacities=_sigmoid(rows[:, OPACITY_LOGIT]),
        rgb=rows[:, RGB].copy(),
        active=active.copy(),
        kappa=kappa.copy(),
        target=target.copy(),
    )


def _sigmoid(logits: Float32[ndarray, " n"]) -> Float32[ndarray, " n"]:
    # the symmetric form cannot overflow
    opacities: Float32[ndarray, " n"] = 0.5 * (np.tanh(0.5 * logits) + 1.0)
    return opacities


def _row_memory(capacity: int) -> Float32[ndarray, "capacity 16"]:
    """Zeroed rows on whole pages (so 64-byte aligned), in huge pages where the system has them."""
    size = capacity * ROW_WIDTH * np.dtype(np.float32).itemsize
    # private: what processes could share, which is what mmap gives unasked, seldom gets huge pages
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    huge_pages = getattr(mmap, "MADV_HUGEPAGE", None)
    if huge_pages is not None:
        memory.madvise(huge_pages)
    return np.frombuffer(memory, np.float32).reshape(capacity, ROW_WIDTH)
