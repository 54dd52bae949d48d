"""The kernels of the cuda backend on the CPU, for tests of the code around them on machines without a GPU.

gsplat compiles its kernels for CUDA only. Its torch versions of the two projection steps run on the CPU. Sorting and
compositing are the oracle's, with gsplat's two different rules (GSPLAT_LIMITS).
"""

from collections.abc import Callable
from typing import Any, cast

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from gausslite.domain.camera import Camera
from gausslite_gpu.kernels import Footprints
from torch_oracle.projection import Ellipses
from torch_oracle.rasterizer import Limits, render_images, render_images_backward

GSPLAT_LIMITS = Limits(max_alpha=0.999, blends_last_splat=False)
"""gsplat clamps alpha at 0.999 and skips the splat that would take the transmittance to 1e-4."""


class TorchKernels:
    """The operations of `gausslite_gpu.kernels.Kernels` on the CPU, slow.

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
    """Forward and backward pass of the oracle's compositing as one differentiable operation."""

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
