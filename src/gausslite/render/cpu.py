"""The CPU backend: checks its input and runs whole training iterations in the C++ kernels (native/)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from operator import is_
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar
from weakref import ref

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt32
from numpy import ndarray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.checks import require_whole
from gausslite.domain.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.rasterizer import (
    DILATION_PX2,
    FULL_FRAME,
    AdamSettings,
    LossWeights,
    Rendering,
    SplatGradients,
    StepReport,
    Subset,
    TrainingView,
    UpdateCounter,
    require_counter,
    require_image_gradients,
    require_scene,
    require_table,
    require_tables,
    require_view,
)

if TYPE_CHECKING:
    from gausslite.render import _kernels


SIMD_VARIABLE = "GAUSSLITE_SIMD"
MAX_THREADS = 256
_CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""CPU limit of a control group (version 2): microseconds per period, or `max`."""
_Table: TypeAlias = Float32[ndarray, "n 16"]
_Tables: TypeAlias = tuple[_Table, _Table, _Table]
_Native = TypeVar("_Native")


def usable_simd() -> tuple[str, ...]:
    """Return the instruction sets of this build that this machine runs, fastest first. Raises KernelError."""
    return tuple(load_kernels().usable_simd())


def load_kernels() -> Any:
    """Return the extension module. Raises KernelError if it is not built for this Python."""
    try:
        from gausslite.render import _kernels
    except ImportError as reason:
        raise KernelError(
            f"native kernels: not built for this Python; install the package again ({reason})"
        ) from reason
    return _kernels


def choose_simd(requested: str | None) -> str:
    """Return the requested instruction set, else the one of the environment, else the fastest. Raises KernelError."""
    usable = usable_simd()
    chosen = requested or os.environ.get(SIMD_VARIABLE) or usable[0]
    if chosen not in usable:
        source = "simd" if requested else SIMD_VARIABLE
        raise KernelError(f"{source}: expected one of {', '.join(usable)} on this machine, got {chosen}")
    return chosen


def cores_allowed(limit: Path = _CPU_LIMIT) -> int:
    """Return the container's CPU limit in cores (`docker run --cpus`), rounded up; MAX_THREADS without a limit."""
    try:
        quota, period = limit.read_text().split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError, ZeroDivisionError):
        return MAX_THREADS


def choose_threads(requested: int | None) -> int:
    """Return the requested number of threads, else one per core that the process may use. Raises KernelError.

    More threads than cores slow all stages down: each stage waits for its last thread.
    """
    if requested is None:
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return min(available, cores_allowed(), MAX_THREADS)
    require_whole("threads", requested)
    if not 1 <= requested <= MAX_THREADS:
        raise KernelError(f"threads: expected 1 to {MAX_THREADS}, got {requested}")
    return requested


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
    dilation_px2: float
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
        native: _kernels.StepScene = load_kernels().StepScene(
            self.native, self.intrinsics, *passed, self.motion, self.dilation_px2
        )
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
        update_counter: UpdateCounter | None,
    ) -> _kernels.StepTraining:
        """Return the native form of tables, settings and counter. Raises ShapeError."""
        arguments, cached = (*tables, *settings, update_counter), self._trainings.get(masked)
        if cached is not None and cached.matches(arguments):
            return cached.native
        is_bound = self._tables is not None and all(map(is_, tables, self._tables))
        if not is_bound:
            require_tables(*tables)
        require_counter(len(tables[0]), update_counter)
        loss, adam = settings
        counts = None if update_counter is None else update_counter.counts
        mask = None if update_counter is None else update_counter.mask
        mask_flags = contiguous(mask)
        native: _kernels.StepTraining = load_kernels().StepTraining(
            tables=tables,
            loss=(loss.colour, loss.depth, loss.ssim, loss.normalise_by_image),
            rates=_row_rates(adam),
            adam=(adam.beta1, adam.beta2, adam.epsilon, adam.decay_after_updates),
            masked=masked,
            update_counts=counts,
            count_mask=mask_flags,
            binding_id=self._binding_id if is_bound else 0,
        )
        if is_bound and mask_flags is mask:
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
        self.simd = choose_simd(simd)
        count = choose_threads(threads)
        try:
            self._engine: _kernels.Engine = load_kernels().Engine(self.simd, count)
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
        dilation_px2: float = DILATION_PX2,
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
                motion=native_motion(motion),
                dilation_px2=dilation_px2,
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
        dilation_px2: float = DILATION_PX2,
    ) -> TrainingView:
        """Return the image in the kernels' layout.

        Raises ShapeError, InvalidInputError if a weight is outside [0, 1].
        """
        require_view(rgb, depth_m, camera, pixel_weights)
        native = load_kernels().View(
            np.ascontiguousarray(rgb), np.ascontiguousarray(depth_m), contiguous(pixel_weights)
        )
        return CpuView(camera, intrinsics(camera), native_motion(motion), dilation_px2, native)

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
        update_counter: UpdateCounter | None = None,
    ) -> StepReport:
        """Run one training iteration in place. Raises ShapeError, also for a view of another backend."""
        if not isinstance(view, CpuView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        with self._lock:
            scene = view.scene(len(rows), T_camera_world, subset, masked)
            tables = rows, first_moment, second_moment
            training = self._binding.training(tables, (loss, adam), masked, update_counter)
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
