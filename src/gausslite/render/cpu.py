"""The CPU backend: checks its input and runs whole training iterations in the C++ kernels (native/)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import RLock
from typing import TYPE_CHECKING
from weakref import ref

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt32
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.checks import (
    require_image_gradients,
    require_scene,
    require_table,
    require_view,
)
from gausslite.render.cpu_arguments import CpuView, TableBinding, contiguous, intrinsics, native_motion
from gausslite.render.cpu_kernels import choose_simd, choose_threads, load_kernels
from gausslite.render.rasterizer import (
    FULL_FRAME,
    AdamSettings,
    LossWeights,
    Rendering,
    SplatGradients,
    StepReport,
    Subset,
    TrainingView,
    UpdateCounter,
)

if TYPE_CHECKING:
    from gausslite.render import _kernels


@dataclass(frozen=True, slots=True, eq=False)
class _ForwardContext:
    """The rasterizer, frame number and input of a rendering; `backward` reads the rows again."""

    owner: CpuRasterizer
    frame: int
    rows: Float32[ndarray, "n 16"]
    T_camera_world: Float64[ndarray, "4 4"]


class _Report:
    """The report of a step. The visible rows are copied on first access, or before the kernels overwrite them."""

    __slots__ = ("__weakref__", "_engine", "_lock", "_visible", "loss")

    def __init__(self, loss: float, engine: _kernels.Engine, lock: RLock) -> None:
        self.loss = loss
        self._engine = engine
        self._lock = lock
        self._visible: UInt32[ndarray, " m"] | None = None

    @property
    def visible(self) -> UInt32[ndarray, " m"]:
        """The visible rows, ascending."""
        with self._lock:
            if self._visible is None:
                self._visible = self._engine.visible()
            return self._visible


class CpuRasterizer:
    """C++ kernels on a persistent thread pool. Results do not depend on the number of threads.

    Concurrent calls from several Python threads run one after the other. The pool's threads do not survive a fork:
    create the rasterizer in the child process.

    threads: by default one per core that the process may use. simd: `avx512`, `avx2`, `neon` or `portable`; by default
    the environment variable GAUSSLITE_SIMD, else the fastest set of this machine. Raises KernelError if the kernels are
    not built, the instruction set is not usable or the threads cannot be started.
    """

    def __init__(self, threads: int | None = None, simd: str | None = None) -> None:
        self._simd = choose_simd(simd)
        count = choose_threads(threads)
        try:
            self._engine: _kernels.Engine = load_kernels().Engine(self._simd, count)
        except RuntimeError as reason:
            raise KernelError(f"threads: expected a number that can be started, got {count} ({reason})") from reason
        self._lock = RLock()
        self._latest: ref[_Report] | None = None
        self._binding = TableBinding()

    @property
    def name(self) -> str:
        """`cpu`."""
        return "cpu"

    @property
    def simd(self) -> str:
        """Name of the instruction set in use."""
        return self._simd

    @property
    def threads(self) -> int:
        """Number of threads, including the caller's."""
        return self._engine.threads

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
        motion: CameraMotion | None = None,
    ) -> Rendering:
        """Render the splats. Raises ShapeError, InvalidInputError if the ids are not ascending row numbers."""
        require_table("rows", rows)
        require_scene(len(rows), camera, T_camera_world, subset)
        T_camera_world = np.ascontiguousarray(T_camera_world)
        with self._lock:
            self._fetch_visible_rows()
            rgb, depth_m, alpha, frame = self._engine.forward(
                rows,
                intrinsics(camera),
                T_camera_world,
                contiguous(subset.tiles),
                contiguous(subset.ids),
                native_motion(motion),
            )
        return Rendering(rgb, depth_m, alpha, _ForwardContext(self, frame, rows, T_camera_world))

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Return the gradients of a scalar, given its derivatives with respect to the rendered images.

        The rows must be unchanged since `forward`. Raises ShapeError, InvalidInputError if the rendering is not this
        backend's latest.
        """
        context = rendering.context
        with self._lock:
            if not self._is_latest(context):
                raise InvalidInputError("rendering: expected the latest forward of this rasterizer, got another one")
            require_image_gradients(rendering, d_rgb, d_depth_m, d_alpha)
            d_rows, d_twist, visible, norms = self._engine.backward(
                context.frame,
                len(context.rows),
                np.ascontiguousarray(d_rgb),
                np.ascontiguousarray(d_depth_m),
                np.ascontiguousarray(d_alpha),
            )
        return SplatGradients(d_rows, d_twist, visible, norms)

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        pixel_weights: Float32[ndarray, "h w"] | None = None,
        motion: CameraMotion | None = None,
    ) -> TrainingView:
        """Return the image in the kernels' layout.

        Raises ShapeError, InvalidInputError if a weight is outside [0, 1].
        """
        require_view(rgb, depth_m, camera, pixel_weights)
        native = load_kernels().View(
            np.ascontiguousarray(rgb), np.ascontiguousarray(depth_m), contiguous(pixel_weights)
        )
        return CpuView(camera, intrinsics(camera), native_motion(motion), native)

    def step(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
        view: TrainingView,
        T_camera_world: Float64[ndarray, "4 4"],
        loss: LossWeights,
        adam: AdamSettings,
        masked: bool = False,
        subset: Subset = FULL_FRAME,
        trainable: Bool[ndarray, " n"] | None = None,
        update_counter: UpdateCounter | None = None,
    ) -> StepReport:
        """Run one training iteration in place. Raises ShapeError, also for a view of another backend."""
        if not isinstance(view, CpuView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        with self._lock:
            scene = view.scene(len(rows), T_camera_world, subset, masked)
            tables = rows, first_moment, second_moment
            training = self._binding.training(tables, (loss, adam), masked, trainable, update_counter)
            self._fetch_visible_rows()
            report = _Report(self._engine.step(scene, training), self._engine, self._lock)
            self._latest = ref(report)
        return report

    @contextmanager
    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> Iterator[None]:
        """Check the tables once for all steps in this context; steps work on the arrays themselves.

        Only steps change bound rows, so the kernels keep the bounds of all rows from step to step. Raises ShapeError,
        InvalidInputError if tables are bound already.
        """
        with self._binding.bind((rows, first_moment, second_moment)):
            yield

    def stage_times_ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage of the latest call: project, raster, loss, backward, update."""
        with self._lock:
            return self._engine.stage_times_ms()

    def steps_s(self, masked: bool | None = None) -> float:
        """Return the kernels' total time in seconds of all steps, of the masked (True) or the other steps (False)."""
        with self._lock:
            all_ms, masked_ms = self._engine.steps_ms, self._engine.masked_steps_ms
        total_ms = all_ms if masked is None else masked_ms if masked else all_ms - masked_ms
        return total_ms / 1e3

    def block_evaluations(self) -> int:
        """Return how many pairs of a splat and a 4x4 pixel block the latest forward or step composited."""
        with self._lock:
            return self._engine.block_evaluations

    def _is_latest(self, context: object) -> bool:
        return isinstance(context, _ForwardContext) and context.owner is self and context.frame == self._engine.frame

    def _fetch_visible_rows(self) -> None:
        """Copy the visible rows of the latest report, if it is still referenced, before the kernels overwrite them."""
        report = None if self._latest is None else self._latest()
        if report is not None:
            _ = report.visible
