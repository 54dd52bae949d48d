"""Store the trainable Gaussians and their optimiser state in memory of fixed capacity."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int16, Int32, Int64, UInt32
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.arrays import require_array, require_finite
from gausslite.domain.errors import InvalidInputError, MapFileError, QuotaError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State, get_array
from gausslite.render.rasterizer import (
    GRAD_2D_SUM,
    LOG_SCALE,
    MEAN,
    OPACITY_LOGIT,
    RGB,
    ROW_WIDTH,
    UPDATE_COUNT,
    allocate_rows,
    gaussians_to_rows,
    row_opacities,
    rows_to_gaussians,
)

_COLUMNS: dict[str, tuple[int | None, type[np.generic]]] = {
    "rows": (ROW_WIDTH, np.float32),
    "first_moment": (ROW_WIDTH, np.float32),
    "second_moment": (ROW_WIDTH, np.float32),
    "ema_rows": (ROW_WIDTH, np.float32),
    "active": (None, np.bool_),
    "kappa": (None, np.uint32),
    "target": (None, np.int16),
    "roi_evidence": (None, np.int16),
    "anchor": (None, np.int32),
}
"""Width (None: a vector) and type of each column of the table and of its saved state."""
NO_ANCHOR = -1
"""Anchor of Gaussians that follow no keyframe: those of an initial map and of teammates."""
_MAX_LOG_SCALE = 80.0
"""The exponential of a larger value is not a finite float32."""
_MAX_MOMENT_RATIO, _MOMENT_TOLERANCE = 1e6, 1e-30
"""Bounds of (first moment)² against the second. By the Cauchy-Schwarz inequality their ratio is at most
(1 - b1)² / ((1 - b2) (1 - b1² / b2)): 53 for Adam's usual betas. The margin allows other betas; the tolerance, second
moments that float32 rounds to 0."""
_BYTES_PER_GAUSSIAN = sum((width or 1) * np.dtype(dtype).itemsize for width, dtype in _COLUMNS.values())
_ROWS_IN_CACHE = 4096
"""Rows that an update of the EMA reads at once: with their averages 512 KiB, which a core's cache holds."""
_UPDATES_OF_TRAINED = 100
"""Updates from which on a row's second moment is typical; the largest number of any row, if that is less."""
_MIN_UPDATES_PER_HORIZON = 8.0
"""The EMA horizon of a row is at most its number of updates divided by this."""


def require_memory(capacity: int) -> None:
    """Raise InvalidInputError for a table larger than the machine's memory; nothing is allocated."""
    if capacity * _BYTES_PER_GAUSSIAN > os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"):
        raise _too_large(capacity)


def _too_large(capacity: int) -> InvalidInputError:
    fits = f"fits in memory ({_BYTES_PER_GAUSSIAN} bytes per Gaussian)"
    return InvalidInputError(f"max_gaussians: expected a table that {fits}, got {capacity}")


class SplatTable:
    """Encoded parameters of the Gaussians, their EMA, Adam's two moments and per-Gaussian columns (Sec. III-A).

    `count`, the number of Gaussians, never exceeds `capacity`, the cap (`max-gaussians`). All arrays are views of the
    first `count` rows; `append`, `append_rows` and `keep` invalidate earlier views.
    """

    def __init__(self, capacity: int) -> None:
        """Allocate an empty table. Raises InvalidInputError if capacity is below 1 or exceeds the memory."""
        if capacity < 1:
            raise InvalidInputError(f"table capacity: expected at least 1 Gaussian, got {capacity}")
        self.capacity, self.count = capacity, 0
        try:
            self._columns: dict[str, NDArray[Any]] = {
                name: np.zeros(capacity, dtype) if width is None else allocate_rows(capacity)
                for name, (width, dtype) in _COLUMNS.items()
            }
        except (OSError, MemoryError, OverflowError, ValueError):
            raise _too_large(capacity) from None

    @property
    def free_slots(self) -> int:
        """Number of Gaussians that still fit."""
        return self.capacity - self.count

    @property
    def optimizer_bytes(self) -> int:
        """Memory allocated for Adam's two moments."""
        return self._columns["first_moment"].nbytes + self._columns["second_moment"].nbytes

    @property
    def table_bytes(self) -> int:
        """Memory allocated for everything but the optimiser state."""
        return sum(column.nbytes for column in self._columns.values()) - self.optimizer_bytes

    @property
    def rows(self) -> Float32[ndarray, "n 16"]:
        """Encoded parameters, in the layout of `render.rasterizer`."""
        return self._columns["rows"][: self.count]

    @property
    def first_moment(self) -> Float32[ndarray, "n 16"]:
        """Adam's first moment; its columns 14 and 15 hold the density statistics."""
        return self._columns["first_moment"][: self.count]

    @property
    def second_moment(self) -> Float32[ndarray, "n 16"]:
        """Adam's second moment."""
        return self._columns["second_moment"][: self.count]

    @property
    def ema_rows(self) -> Float32[ndarray, "n 16"]:
        """Exponential moving average (EMA) of the rows at the last `update_ema`; of a seed, its row."""
        return self._columns["ema_rows"][: self.count]

    @property
    def active(self) -> Bool[ndarray, " n"]:
        """The paper's flag a: seeded inside the region of interest (ROI), or inside it after a task change."""
        return self._columns["active"][: self.count]

    @property
    def kappa(self) -> UInt32[ndarray, " n"]:
        """Steps of the active phase that trained each Gaussian; an iteration has up to `active_views` steps."""
        return self._columns["kappa"][: self.count]

    @property
    def target(self) -> Int16[ndarray, " n"]:
        """Index into TaskGraph.targets, -1 for none."""
        return self._columns["target"][: self.count]

    @property
    def roi_evidence(self) -> Int16[ndarray, " n"]:
        """Number of views with the Gaussian inside the current ROI minus number of views with it outside.

        A new Gaussian starts at 1 if active, else at -1; a clone or half has its parent's.
        """
        return self._columns["roi_evidence"][: self.count]

    @property
    def anchor(self) -> Int32[ndarray, " n"]:
        """Number of the keyframe that each Gaussian follows when poses are corrected; NO_ANCHOR for none."""
        return self._columns["anchor"][: self.count]

    @property
    def update_counts(self) -> Float32[ndarray, " n"]:
        """Number of Adam updates of each Gaussian."""
        return self.rows[:, UPDATE_COUNT]

    @property
    def means_m(self) -> Float32[ndarray, "n 3"]:
        """Means in metres."""
        return self.rows[:, MEAN]

    @property
    def opacities(self) -> Float32[ndarray, " n"]:
        """Opacities in (0, 1)."""
        return row_opacities(self.rows)

    def has_lower_opacity(self, opacity: float) -> Bool[ndarray, " n"]:
        """Return True for each Gaussian whose opacity is lower than this value in (0, 1)."""
        # in logits, so that no row is decoded
        return self.rows[:, OPACITY_LOGIT] < math.log(opacity) - math.log1p(-opacity)

    def most_transparent(self, ids: Int64[ndarray, " m"], count: int) -> Int64[ndarray, " k"]:
        """Return up to `count` of these ascending ids: those of lowest opacity, and of equal ones the lowest ids."""
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
        """Set the three scales of each Gaussian, and of its EMA, to their geometric mean."""
        for log_scales in (self.rows[:, LOG_SCALE], self.ema_rows[:, LOG_SCALE]):
            log_scales[:] = log_scales.mean(axis=1, keepdims=True)

    def clip_colours(self, lowest: float, highest: float) -> None:
        """Clip all colour channels to this range."""
        # one channel at a time: NumPy takes twice as long for three columns at once
        for channel in self.rows[:, RGB].T:
            np.clip(channel, lowest, highest, out=channel)

    def append(self, gaussians: Gaussians, anchor: int = NO_ANCHOR) -> None:
        """Add Gaussians with zero optimiser state. Raises QuotaError if they do not fit."""
        self.append_rows(gaussians_to_rows(gaussians), gaussians.active, gaussians.kappa, gaussians.target, anchor)

    def append_rows(
        self,
        rows: Float32[ndarray, "m 16"],
        active: Bool[ndarray, " m"],
        kappa: UInt32[ndarray, " m"],
        target: Int16[ndarray, " m"],
        anchor: Int32[ndarray, " m"] | int = NO_ANCHOR,
    ) -> None:
        """Add encoded rows with zero optimiser state. Raises QuotaError if they do not fit."""
        if len(rows) > self.free_slots:
            raise QuotaError(f"table: expected at most {self.free_slots} more Gaussians, got {len(rows)}")
        place = slice(self.count, self.count + len(rows))
        self._put(place, rows, active, kappa, target)
        self._columns["anchor"][place] = anchor
        self.count += len(rows)

    def append_children(
        self, parents: Int64[ndarray, " m"], rows: Float32[ndarray, "m 16"], ema_rows: Float32[ndarray, "m 16"]
    ) -> None:
        """Add encoded rows and their averages, with the other columns of their parents and zero optimiser state.

        Raises QuotaError if they do not fit.
        """
        place = slice(self.count, self.count + len(rows))
        self.append_rows(rows, self.active[parents], self.kappa[parents], self.target[parents], self.anchor[parents])
        self.ema_rows[place], self.roi_evidence[place] = ema_rows, self.roi_evidence[parents]

    def replace(self, ids: Int[ndarray, " m"], gaussians: Gaussians, anchor: int = NO_ANCHOR) -> None:
        """Overwrite the Gaussians `ids` with these, with zero optimiser state."""
        self._put(ids, gaussians_to_rows(gaussians), gaussians.active, gaussians.kappa, gaussians.target)
        self._columns["anchor"][ids] = anchor

    def adopt(self, ids: Int64[ndarray, " m"], updates: int, beta2: float) -> None:
        """Give these Gaussians a number of updates, and the median second moment of trained rows, if there are any."""
        counts = self.update_counts.astype(np.float64)
        trained = np.flatnonzero(counts >= min(_UPDATES_OF_TRAINED, max(counts.max(), 1.0)))
        if len(ids) == 0 or len(trained) == 0:
            return
        corrected = self.second_moment[trained] / (1.0 - beta2 ** counts[trained, None])
        self.second_moment[ids] = np.median(corrected, axis=0) * (1.0 - beta2**updates)
        self.first_moment[ids] = 0.0
        self.rows[ids, UPDATE_COUNT] = self.ema_rows[ids, UPDATE_COUNT] = updates

    def keep(self, mask: Bool[ndarray, " n"]) -> None:
        """Remove the Gaussians where mask is False; the others keep their optimiser state.

        The last Gaussians, in their order, move to the rows of the removed ones, so that few rows move.
        """
        require_array("keep mask", mask, (self.count,), np.bool_)
        kept = int(np.count_nonzero(mask))
        # the gaps among the first `kept` rows are as many as the kept rows after them
        vacant, moved = np.flatnonzero(~mask[:kept]), kept + np.flatnonzero(mask[kept:])
        for column in self._columns.values():
            column[vacant] = column[moved]
        self.count = kept

    def remove(self, rows: Int[ndarray, " m"]) -> None:
        """Remove the Gaussians of these rows."""
        if len(rows):
            mask = np.ones(self.count, np.bool_)
            mask[rows] = False
            self.keep(mask)

    def state(self) -> State:
        """Return all columns, as views."""
        return {name: column[: self.count] for name, column in self._columns.items()}

    def restore(self, state: State) -> None:
        """Replace the contents by a saved state. Raises QuotaError if it does not fit, MapFileError, ShapeError."""
        rows = get_array(state, "rows", (None, ROW_WIDTH), np.float32)
        if len(rows) > self.capacity:
            raise QuotaError(f"max_gaussians: expected at least the {len(rows)} saved ones, got {self.capacity}")
        columns = {
            name: get_array(state, name, (len(rows),) if width is None else (len(rows), width), dtype)
            for name, (width, dtype) in _COLUMNS.items()
        }
        for name in ("rows", "first_moment", "second_moment", "ema_rows"):
            require_finite(f"state {name}", columns[name])
        if not _is_reachable(columns):
            raise MapFileError("state table: expected scales, EMA and moments that training can produce, got others")
        for name, column in columns.items():
            self._columns[name][: len(rows)] = column
        self.count = len(rows)

    def update_ema(self, horizon_updates: float, rows: UInt32[ndarray, " m"] | None = None) -> None:
        """Advance the EMA of all rows, or of these, that changed since the last call.

        The horizon of a row is `horizon_updates`, but at most an eighth of its number of updates: an earlier value must
        not hold back a row that still moves far.
        """
        candidates = np.arange(self.count) if rows is None else rows
        counts = (table[candidates, UPDATE_COUNT] for table in (self.rows, self.ema_rows))
        changed = candidates[np.not_equal(*counts)]
        for start in range(0, len(changed), _ROWS_IN_CACHE):
            ids = changed[start : start + _ROWS_IN_CACHE]
            now, ema = self.rows.take(ids, axis=0), self.ema_rows.take(ids, axis=0)
            # a row of n updates since the last call moves by 1 - exp(-n / horizon): calls may come at any interval
            horizon = np.minimum(np.float32(horizon_updates), now[:, UPDATE_COUNT] / _MIN_UPDATES_PER_HORIZON)
            weight = -np.expm1((ema[:, UPDATE_COUNT] - now[:, UPDATE_COUNT]) / horizon)
            ema += weight[:, None] * (now - ema)
            ema[:, UPDATE_COUNT] = now[:, UPDATE_COUNT]
            self.ema_rows[ids] = ema

    def to_gaussians(self, ids: Int[ndarray, " m"] | None = None, use_ema: bool = False) -> Gaussians:
        """Return copies of all Gaussians, or of these ids, as physical values; use_ema: of the EMA rows."""
        chosen = np.arange(self.count) if ids is None else ids
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
        """Write new Gaussians, with zero optimiser state."""
        columns = {"rows": rows, "ema_rows": rows, "active": active, "kappa": kappa, "target": target}
        for name, values in columns.items():
            self._columns[name][place] = values
        self._columns["first_moment"][place] = self._columns["second_moment"][place] = 0.0
        self._columns["roi_evidence"][place] = np.where(active, 1, -1)


def _is_reachable(columns: State) -> bool:
    """Return False for values that training cannot produce and that would ruin the map in its first steps."""
    rows, ema_rows = columns["rows"], columns["ema_rows"]
    if max(values[:, LOG_SCALE].max(initial=-np.inf) for values in (rows, ema_rows)) > _MAX_LOG_SCALE:
        return False
    if (ema_rows[:, UPDATE_COUNT] < 0).any() or (ema_rows[:, UPDATE_COUNT] > rows[:, UPDATE_COUNT]).any():
        return False
    first, second = (columns[name][:, :GRAD_2D_SUM].astype(np.float64) for name in ("first_moment", "second_moment"))
    return bool((second >= 0).all() and (np.square(first) <= _MAX_MOMENT_RATIO * second + _MOMENT_TOLERANCE).all())
