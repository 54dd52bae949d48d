"""Store parameters and Adam's moments on the device, and apply Adam there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64
from numpy import ndarray
from numpy.typing import NDArray
from torch import Tensor

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.render.rasterizer import (
    DILATION_PX2,
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    MAX_UPDATE_COUNT,
    UPDATE_COUNT,
    AdamSettings,
    UpdateCounter,
)
from gausslite_gpu.motion import ImageMotion

_COUNTER_BATCH = 8
"""Number of steps per update of the counters: each update waits for the device."""


def to_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """Copy the array to the device; read-only arrays, which torch cannot share, are copied on the host first."""
    writable = array if array.flags.writeable and array.flags.c_contiguous else array.copy(order="C")
    return torch.from_numpy(writable).to(device)


@dataclass(frozen=True, slots=True, eq=False)
class HostTables:
    """The three arrays of the caller."""

    rows: Float32[ndarray, "n 16"]
    first_moment: Float32[ndarray, "n 16"]
    second_moment: Float32[ndarray, "n 16"]

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray]:
        """The three arrays."""
        return self.rows, self.first_moment, self.second_moment

    def same_memory_as(self, other: HostTables) -> bool:
        """Return True if all three arrays have the same addresses and shapes."""
        return all(
            a.ctypes.data == b.ctypes.data and a.shape == b.shape
            for a, b in zip(self.arrays, other.arrays, strict=True)
        )


class DeviceTables:
    """Copies of the three tables on a device; `write_back` copies them to the host arrays."""

    def __init__(self, host: HostTables, device: torch.device) -> None:
        self.host = host
        # copy=True: a tensor on the CPU would share the memory of the caller
        self.rows, self.first_moment, self.second_moment = (
            torch.from_numpy(array).to(device, copy=True) for array in host.arrays
        )
        self._pending_counts: list[tuple[Int64[Tensor, " m"], UpdateCounter]] = []

    def write_back(self) -> None:
        """Write counters and tables back to the host arrays."""
        self._flush_counts()
        for array, tensor in zip(self.host.arrays, (self.rows, self.first_moment, self.second_moment), strict=True):
            torch.from_numpy(array).copy_(tensor)

    def count(self, row_ids: Int64[Tensor, " m"], update_counter: UpdateCounter) -> None:
        """Count an update of these rows; the counter changes at the latest in `write_back`."""
        self._pending_counts.append((row_ids, update_counter))
        if len(self._pending_counts) == _COUNTER_BATCH:
            self._flush_counts()

    def _flush_counts(self) -> None:
        for row_ids, update_counter in self._pending_counts:
            rows = row_ids.cpu().numpy()
            update_counter.counts[rows if update_counter.mask is None else rows[update_counter.mask[rows]]] += 1
        self._pending_counts.clear()

    @torch.no_grad()
    def update(
        self,
        row_ids: Int64[Tensor, " m"],
        gradients: Float32[Tensor, "m 16"],
        mean_2d_grad_norm: Float32[Tensor, " m"],
        adam: AdamSettings,
    ) -> None:
        """Apply sparse Adam (Kingma and Ba 2015) to these rows and add their density statistics.

        The bias correction uses each row's own number of updates.
        """
        first = self.first_moment[row_ids]
        second = self.second_moment[row_ids]
        rows = self.rows[row_ids]
        columns = slice(0, UPDATE_COUNT)
        gradient = gradients[:, columns]
        first[:, columns].lerp_(gradient, 1.0 - adam.beta1)
        second[:, columns].mul_(adam.beta2).addcmul_(gradient, gradient, value=1.0 - adam.beta2)
        updates = (rows[:, UPDATE_COUNT, None] + 1.0).clamp(max=MAX_UPDATE_COUNT)
        rate_decay = (adam.decay_after_updates / updates).clamp(max=1.0).sqrt()
        rates = to_device(adam.row_rates()[columns], rows.device)
        first_unbiased = first[:, columns] / (1.0 - adam.beta1**updates)
        second_unbiased = second[:, columns] / (1.0 - adam.beta2**updates)
        rows[:, columns] -= rate_decay * rates * first_unbiased / (second_unbiased.sqrt() + adam.epsilon)
        rows[:, UPDATE_COUNT] += 1.0
        first[:, GRAD_2D_SUM] += mean_2d_grad_norm
        first[:, GRAD_2D_COUNT] += 1.0
        self.rows[row_ids], self.first_moment[row_ids], self.second_moment[row_ids] = rows, first, second


@dataclass(frozen=True, slots=True, eq=False)
class DeviceCamera:
    """A camera on the device, with the principal point at the image centre; shift_px: from there to the real one.

    gsplat clamps the tangent around the optical axis, the interface around the centre of the image. They agree with the
    principal point at the centre; shift_px is added to the projected means.
    """

    size: tuple[int, int]
    intrinsics: Float32[Tensor, "3 3"]
    shift_px: Float32[Tensor, "2"]
    half_size_px: Float32[Tensor, "2"]
    motion: ImageMotion | None
    dilation_px2: float

    @classmethod
    def of(
        cls,
        camera: Camera,
        device: torch.device,
        motion: CameraMotion | None = None,
        dilation_px2: float = DILATION_PX2,
    ) -> DeviceCamera:
        """Return the device form of this camera and its motion."""
        middle_px = np.array([camera.width_px, camera.height_px]) / 2.0
        intrinsics = [[camera.fx_px, 0.0, middle_px[0]], [0.0, camera.fy_px, middle_px[1]], [0.0, 0.0, 1.0]]
        shift_px = np.array([camera.cx_px, camera.cy_px]) - middle_px
        return cls(
            (camera.width_px, camera.height_px),
            torch.tensor(intrinsics, dtype=torch.float32, device=device),
            torch.tensor(shift_px, dtype=torch.float32, device=device),
            torch.tensor(middle_px, dtype=torch.float32, device=device),
            ImageMotion.of(camera, motion, torch.float32, device),
            dilation_px2,
        )
