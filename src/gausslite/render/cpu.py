"""The native CPU backend: checks its input, then hands whole iterations to the C++ kernels."""

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
from gausslite.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.checks import (
    require_image_gradients,
    require_scene,
    require_table,
    require_view,
)
from gausslite.render.cpu_arguments import CpuView, Loans, contiguous, intrinsics
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
class _Drawn:
    """Which frame of which rasterizer a rendering is, and the rows it was drawn from: the way back reads them again."""

    owner: CpuRasterizer
    frame: int
    rows: Float32[ndarray, "n 16"]
    T_camera_world: Float64[ndarray, "4 4"]


class _Report:
    """What a step did. The visible rows stay in the kernels' memory until they are read, or drawn over."""

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
    """C++ kernels with a persistent team of threads; results do not depend on the number of threads.

    Calls from several Python threads are served one after the other.

    threads: by default one per core this process may use. simd: `avx512`, `avx2`, `neon` or `portable`; by default
    the environment variable GAUSSLITE_SIMD, and without it the fastest this machine runs. Raises KernelError when the
    kernels are not built or the choice is impossible. Threads do not survive a fork: build it in the child.
    """

    def __init__(self, threads: int | None = None, simd: str | None = None) -> None:
        self._simd = choose_simd(simd)
        count = choose_threads(threads)
        try:
            self._engine: _kernels.Engine = load_kernels().Engine(self._simd, count)
        except RuntimeError as reason:
            raise KernelError(f"threads: expected as many as can be started, {count} cannot ({reason})") from reason
        self._lock = RLock()
        self._latest: ref[_Report] | None = None
        self._loans = Loans()

    @property
    def name(self) -> str:
        """`cpu`."""
        return "cpu"

    @property
    def simd(self) -> str:
        """The instruction set in use."""
        return self._simd

    @property
    def threads(self) -> int:
        """Members of the team, the caller included."""
        return self._engine.threads

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
    ) -> Rendering:
        """Draw the splats. Raises ShapeError, InvalidInputError for ids that are not ascending rows."""
        require_table("rows", rows)
        require_scene(len(rows), camera, T_camera_world, subset)
        T_camera_world = np.ascontiguousarray(T_camera_world)
        with self._lock:
            self._settle_report()
            rgb, depth_m, alpha, frame = self._engine.forward(
                rows, intrinsics(camera), T_camera_world, contiguous(subset.tiles), contiguous(subset.ids)
            )
        return Rendering(rgb, depth_m, alpha, _Drawn(self, frame, rows, T_camera_world))

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Gradients of a scalar whose derivatives by the rendering's images are given.

        The rows must not have changed since. Raises ShapeError, InvalidInputError for a rendering that is not this
        backend's latest.
        """
        drawn = rendering.context
        with self._lock:
            if not isinstance(drawn, _Drawn) or drawn.owner is not self or drawn.frame != self._engine.frame:
                raise InvalidInputError("rendering: expected the latest forward of this rasterizer, got another one")
            require_image_gradients(rendering, d_rgb, d_depth_m, d_alpha)
            d_rows, d_twist, visible, norms = self._engine.backward(
                drawn.frame,
                len(drawn.rows),
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
        weight: Float32[ndarray, "h w"] | None = None,
    ) -> TrainingView:
        """Make an image ready to train on. Raises ShapeError, InvalidInputError for weights outside [0, 1]."""
        require_view(rgb, depth_m, camera, weight)
        native = load_kernels().View(np.ascontiguousarray(rgb), np.ascontiguousarray(depth_m), contiguous(weight))
        return CpuView(camera, intrinsics(camera), native)

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
        """One whole iteration in place. Raises ShapeError, also for a view of another backend."""
        if not isinstance(view, CpuView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        with self._lock:
            scene = view.scene(len(rows), T_camera_world, subset, masked)
            training = self._loans.training((rows, first_moment, second_moment), (loss, adam), masked, trainable, update_counter)
            self._settle_report()
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
        """Nothing to carry: steps work on the arrays themselves, which are checked once here.

        Raises ShapeError, InvalidInputError where tables are on loan already.
        As nobody else changes the rows, the kernels keep where each one is from step to step.
        """
        with self._loans.lend((rows, first_moment, second_moment)):
            yield

    def stage_times_ms(self) -> dict[str, float]:
        """Milliseconds that the stages of the latest call took: project, raster, loss, backward, update."""
        with self._lock:
            return self._engine.stage_times_ms()

    def steps_s(self, masked: bool | None = None) -> float:
        """Seconds that all steps so far spent in the kernels, or only those masked to a region, or only the others."""
        with self._lock:
            all_ms, masked_ms = self._engine.steps_ms, self._engine.masked_steps_ms
        spent_ms = all_ms if masked is None else masked_ms if masked else all_ms - masked_ms
        return spent_ms / 1e3

    def block_evaluations(self) -> int:
        """How often the latest forward or step composited a splat on a 4x4 block of pixels."""
        with self._lock:
            return self._engine.block_evaluations

    def _settle_report(self) -> None:
        """A report that somebody still holds gets its rows before the kernels draw over them."""
        report = None if self._latest is None else self._latest()
        if report is not None:
            _ = report.visible
