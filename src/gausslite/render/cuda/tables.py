"""Keep parameters and Adam's moments on the device, and move them there by Adam's rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Int64
from numpy import ndarray
from numpy.typing import NDArray
from torch import Tensor

from gausslite.render.rasterizer import (
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    MAX_UPDATE_COUNT,
    UPDATE_COUNT,
    AdamSettings,
    UpdateCounter,
)

_COUNT_EVERY = 8
"""So many tallies wait to be written together, so that the device runs on meanwhile."""


def to_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """The array on the device; of one that may not be written, which torch refuses to share, a copy."""
    writable = array if array.flags.writeable and array.flags.c_contiguous else array.copy(order="C")
    return torch.from_numpy(writable).to(device)


@dataclass(frozen=True, slots=True, eq=False)
class HostTables:
    """The caller's three arrays."""

    rows: Float32[ndarray, "n 16"]
    first_moment: Float32[ndarray, "n 16"]
    second_moment: Float32[ndarray, "n 16"]

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray]:
        """All three."""
        return self.rows, self.first_moment, self.second_moment

    def same_memory_as(self, other: HostTables) -> bool:
        """True when all three are the same rows in the same place (views of a table are made anew at each call)."""
        return all(
            a.ctypes.data == b.ctypes.data and a.shape == b.shape
            for a, b in zip(self.arrays, other.arrays, strict=True)
        )


class DeviceTables:
    """The three tables on a device. The copy is made at birth; `write_back` returns what became of it."""

    def __init__(self, host: HostTables, device: torch.device) -> None:
        self.host = host
        # cloned, because on the processor a tensor would share the caller's memory
        self.rows, self.first_moment, self.second_moment = (
            torch.from_numpy(array).to(device, copy=True) for array in host.arrays
        )
        self._uncounted: list[tuple[Int64[Tensor, " m"], UpdateCounter]] = []

    def write_back(self) -> None:
        """Bring the caller's arrays up to date."""
        self._write_tallies()
        for array, tensor in zip(self.host.arrays, (self.rows, self.first_moment, self.second_moment), strict=True):
            torch.from_numpy(array).copy_(tensor)

    def count(self, moved: Int64[Tensor, " m"], update_counter: UpdateCounter) -> None:
        """These rows were trained; the update_counter learns of it by the end of the loan."""
        self._uncounted.append((moved, update_counter))
        if len(self._uncounted) == _COUNT_EVERY:
            self._write_tallies()

    def _write_tallies(self) -> None:
        for moved, update_counter in self._uncounted:
            rows = moved.cpu().numpy()
            update_counter.counts[rows if update_counter.mask is None else rows[update_counter.mask[rows]]] += 1
        self._uncounted.clear()

    @torch.no_grad()
    def update(
        self,
        moving: Int64[Tensor, " m"],
        gradients: Float32[Tensor, "m 16"],
        mean_2d_norm: Float32[Tensor, " m"],
        adam: AdamSettings,
    ) -> None:
        """Sparse Adam (Kingma and Ba 2015) on these rows, each with its own count of updates, and its statistics."""
        first = self.first_moment[moving]
        second = self.second_moment[moving]
        rows = self.rows[moving]
        trained = slice(0, UPDATE_COUNT)
        gradient = gradients[:, trained]
        first[:, trained].lerp_(gradient, 1.0 - adam.beta1)
        second[:, trained].mul_(adam.beta2).addcmul_(gradient, gradient, value=1.0 - adam.beta2)
        updates = (rows[:, UPDATE_COUNT, None] + 1.0).clamp(max=MAX_UPDATE_COUNT)
        slowed = (adam.decay_after_updates / updates).clamp(max=1.0).sqrt()
        rates = to_device(adam.row_rates()[trained], rows.device)
        first_unbiased = first[:, trained] / (1.0 - adam.beta1**updates)
        second_unbiased = second[:, trained] / (1.0 - adam.beta2**updates)
        rows[:, trained] -= slowed * rates * first_unbiased / (second_unbiased.sqrt() + adam.epsilon)
        rows[:, UPDATE_COUNT] += 1.0
        first[:, GRAD_2D_SUM] += mean_2d_norm
        first[:, GRAD_2D_COUNT] += 1.0
        self.rows[moving], self.first_moment[moving], self.second_moment[moving] = rows, first, second
