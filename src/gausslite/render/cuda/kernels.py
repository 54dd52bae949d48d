"""The gsplat operations of this backend, and an emulation in torch for machines without a GPU.

gsplat (Ye et al. 2025, Apache-2.0) compiles its kernels for CUDA only. Its torch versions of the two projection steps
run on the CPU. The emulation replaces sorting and compositing by those of the reference backend, with gsplat's two
different rules (GSPLAT_LIMITS).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol, cast, runtime_checkable

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from gausslite.domain.camera import Camera
from gausslite.domain.errors import KernelError
from gausslite.render.rasterizer import TILE_PX
from gausslite.render.reference.compositing import Limits, render_images, render_images_backward
from gausslite.render.reference.projection import Ellipses

GSPLAT_LIMITS = Limits(max_alpha=0.999, blends_last_splat=False)
"""gsplat clamps alpha at 0.999 and skips the splat that would take the transmittance to 1e-4."""


@dataclass(frozen=True, slots=True, eq=False)
class Footprints:
    """Input of the compositing kernels: splats in any order, in pixels of the rendered window.

    channels: red, green, blue and z. order_m: splats are blended in ascending order of it. radius_px: half the bounding
    box of alpha >= 1/255.
    """

    means_px: Float32[Tensor, "m 2"]
    conics: Float32[Tensor, "m 3"]
    opacities: Float32[Tensor, " m"]
    channels: Float32[Tensor, "m 4"]
    order_m: Float32[Tensor, " m"]
    radius_px: Float32[Tensor, "m 2"]


@runtime_checkable
class Kernels(Protocol):
    """Differentiable operations of gsplat on one device."""

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        ...

    def covariances(self, quats_wxyz: Float32[Tensor, "m 4"], scales_m: Float32[Tensor, "m 3"]) -> Tensor:
        """Return the covariances [m 3 3] in the frame of the means."""
        ...

    def project(
        self,
        points_m: Float32[Tensor, "m 3"],
        covariances_m2: Float32[Tensor, "m 3 3"],
        intrinsics: Float32[Tensor, "3 3"],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Return means [m 2] and covariances [m 2 2] in the image of this width and height, from the camera frame."""
        ...

    def composite(
        self, footprints: Footprints, size: tuple[int, int], tiles: Bool[Tensor, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        """Return channels [h w 4] and alpha [h w] of a window of this width and height; zero outside the tiles."""
        ...


def load_gsplat() -> ModuleType:
    """Import gsplat and its kernels; unless the wheel contains them, the first use compiles them in some minutes.

    Raises KernelError without a CUDA toolkit, ImportError without gsplat.
    """
    import gsplat
    from gsplat.cuda import _backend

    if _backend._C is None:
        raise KernelError("cuda backend: expected nvcc to compile gsplat's kernels with, got no CUDA toolkit")
    return cast(ModuleType, gsplat)


class GsplatKernels:
    """gsplat on a CUDA device."""

    def __init__(self, gsplat: Any, device: torch.device) -> None:
        self._gsplat = gsplat
        self._device = device

    @property
    def device(self) -> torch.device:
        """The CUDA device."""
        return self._device

    def covariances(self, quats_wxyz: Float32[Tensor, "m 4"], scales_m: Float32[Tensor, "m 3"]) -> Tensor:
        """Return the covariances [m 3 3]."""
        covariances, _ = self._gsplat.quat_scale_to_covar_preci(quats_wxyz, scales_m, compute_preci=False)
        return cast(Tensor, covariances)

    def project(
        self,
        points_m: Float32[Tensor, "m 3"],
        covariances_m2: Float32[Tensor, "m 3 3"],
        intrinsics: Float32[Tensor, "3 3"],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Return means and covariances in the image."""
        means_px, covariances_px2 = self._gsplat.proj(points_m[None], covariances_m2[None], intrinsics[None], *size)
        return means_px[0], covariances_px2[0]

    def composite(
        self, footprints: Footprints, size: tuple[int, int], tiles: Bool[Tensor, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        """Sort the splats by tile and depth, and blend them front to back."""
        width_px, height_px = size
        tile_rows, tile_columns = -(-height_px // TILE_PX), -(-width_px // TILE_PX)
        _, crossings, owners = self._gsplat.isect_tiles(
            footprints.means_px.detach()[None],
            footprints.radius_px.ceil().to(torch.int32)[None],
            footprints.order_m[None],
            TILE_PX,
            tile_columns,
            tile_rows,
        )
        channels, alpha = self._gsplat.rasterize_to_pixels(
            footprints.means_px[None],
            footprints.conics[None],
            footprints.channels[None],
            footprints.opacities[None],
            image_width=width_px,
            image_height=height_px,
            tile_size=TILE_PX,
            isect_offsets=self._gsplat.isect_offset_encode(crossings, 1, tile_columns, tile_rows),
            flatten_ids=owners,
            masks=None if tiles is None else tiles[None],
        )
        if tiles is None:
            return channels[0], alpha[0, ..., 0]
        # gsplat's kernel does not write alpha in inactive tiles
        is_active = tiles.repeat_interleave(TILE_PX, 0).repeat_interleave(TILE_PX, 1)[:height_px, :width_px]
        return torch.where(is_active[..., None], channels[0], 0.0), torch.where(is_active, alpha[0, ..., 0], 0.0)


class TorchKernels:
    """The same operations on the CPU, slow, for tests of the code around the kernels.

    They compute in double precision. gsplat's functions use matrix products, whose rounding depends on the number of
    rows and on the processor. In single precision the image of a subset would differ from that of the whole map.
    """

    def __init__(self) -> None:
        from gsplat.cuda import _torch_impl

        self._gsplat: Any = _torch_impl

    @property
    def device(self) -> torch.device:
        """The CPU."""
        return torch.device("cpu")

    def covariances(self, quats_wxyz: Float32[Tensor, "m 4"], scales_m: Float32[Tensor, "m 3"]) -> Tensor:
        """Return the covariances [m 3 3]."""
        covariances, _ = self._gsplat._quat_scale_to_covar_preci(
            quats_wxyz.double(), scales_m.double(), compute_preci=False
        )
        return cast(Tensor, covariances).float()

    def project(
        self,
        points_m: Float32[Tensor, "m 3"],
        covariances_m2: Float32[Tensor, "m 3 3"],
        intrinsics: Float32[Tensor, "3 3"],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Return means and covariances in the image."""
        means_px, covariances_px2 = self._gsplat._persp_proj(
            points_m[None].double(), covariances_m2[None].double(), intrinsics[None].double(), *size
        )
        return means_px[0].float(), covariances_px2[0].float()

    def composite(
        self, footprints: Footprints, size: tuple[int, int], tiles: Bool[Tensor, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        """Blend front to back with gsplat's limits."""
        columns = (footprints.means_px, footprints.conics, footprints.opacities, footprints.channels)
        blend: Callable[..., Tensor] = _Composite.apply
        images = blend(*columns, footprints.order_m, footprints.radius_px, size, tiles)
        return images[..., :4].float(), images[..., 4].float()


class _Composite(torch.autograd.Function):
    """Forward and backward pass of the reference compositing as one differentiable operation."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        """Return images of five channels, in double precision."""
        means_px, conics, opacities, channels, order_m, radius_px, (width_px, height_px), tiles = inputs
        order = torch.argsort(order_m, stable=True)
        columns = (column[order].double() for column in (means_px, conics, opacities, channels, radius_px))
        means_px, conics, opacities, channels, radius_px = columns
        ctx.ellipses = Ellipses(
            row_ids=order,
            means_px=means_px,
            conics=conics,
            opacities=opacities,
            rgb=channels[:, :3],
            z_m=channels[:, 3],
            half_box_px=torch.ceil(radius_px),
        )
        # compositing uses only the image size of a camera
        ctx.camera = Camera(1.0, 1.0, 0.0, 0.0, width_px, height_px)
        ctx.tiles = None if tiles is None else tiles.numpy()
        return render_images(ctx.ellipses, ctx.camera, ctx.tiles, GSPLAT_LIMITS)

    @staticmethod
    def backward(ctx: Any, *d_images: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients in single precision, in the order of the input."""
        ellipses: Ellipses = ctx.ellipses
        with torch.enable_grad():
            sums = render_images_backward(ellipses, ctx.camera, ctx.tiles, d_images[0], GSPLAT_LIMITS)
        d_means_px, d_conics, d_opacities, d_rgb, d_z_m = sums
        d_channels = torch.cat([d_rgb, d_z_m[:, None]], dim=1)
        inverse_order = torch.argsort(ellipses.row_ids)
        columns = (d_means_px, d_conics, d_opacities, d_channels)
        return (*(column[inverse_order].float() for column in columns), None, None, None, None)
