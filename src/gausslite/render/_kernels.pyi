"""The native extension as Python sees it (native/src/bindings.cpp); use gausslite.render.cpu.CpuRasterizer."""

from collections.abc import Sequence

from jaxtyping import Bool, Float32, Float64, UInt8, UInt32
from numpy import ndarray

def usable_simd() -> list[str]:
    """Instruction sets this build has and this machine runs, fastest first."""

def core_clock_ghz() -> float:
    """The clock of this core, by a chain of additions."""

class View:
    """A training image made ready: cut into tiles, and where its weights are."""

    def __init__(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        weight: Float32[ndarray, "h w"] | None,
    ) -> None: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...

class StepScene:
    """What a step looks at; it keeps the arrays, not their values."""

    def __init__(
        self,
        view: View,
        intrinsics: tuple[float, float, float, float, int, int],
        T_camera_world: Float64[ndarray, "4 4"],
        tiles: Bool[ndarray, "th tw"] | None,
        ids: UInt32[ndarray, " m"] | None,
    ) -> None: ...

class StepTraining:
    """What a step changes and how; it keeps the arrays, not their values."""

    def __init__(
        self,
        tables: tuple[Float32[ndarray, "n 16"], Float32[ndarray, "n 16"], Float32[ndarray, "n 16"]],
        loss: tuple[float, float, float, bool],
        rates: Sequence[float],
        adam: tuple[float, float, float, float],
        masked: bool,
        trainable: Bool[ndarray, " n"] | None,
        trained: UInt32[ndarray, " n"] | None,
        counted: Bool[ndarray, " n"] | None,
        loan: int,
    ) -> None:
        """The values of adam are beta1, beta2, epsilon, decay_after_updates. trained rises by one for each row that moved
        and is counted.

        loan: numbers a time in which the rows change by steps of this number alone; 0 where others may change them.
        """

class Engine:
    """Scratch memory and a team of threads; it never keeps the splats."""

    def __init__(self, simd: str, threads: int) -> None: ...
    @property
    def threads(self) -> int: ...
    @property
    def frame(self) -> int:
        """The number of the latest forward or step."""

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        intrinsics: tuple[float, float, float, float, int, int],
        T_camera_world: Float64[ndarray, "4 4"],
        tiles: Bool[ndarray, "th tw"] | None,
        ids: UInt32[ndarray, " m"] | None,
    ) -> tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w"], Float32[ndarray, "h w"], int]:
        """rgb, depth_m, alpha and the frame's number; intrinsics are fx, fy, cx, cy, width, height."""

    def backward(
        self,
        frame: int,
        row_count: int,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> tuple[Float32[ndarray, "n 16"], Float64[ndarray, "6"], UInt32[ndarray, " m"], Float32[ndarray, " m"]]:
        """d_rows, d_twist, visible rows and mean_2d_norm."""

    def step(self, scene: StepScene, training: StepTraining) -> float:
        """The loss."""

    def visible(self) -> UInt32[ndarray, " m"]:
        """The rows that the last forward or step found visible, ascending."""

    @property
    def steps_ms(self) -> float:
        """Milliseconds that all steps took so far."""

    @property
    def masked_steps_ms(self) -> float:
        """... and those masked to a region."""

    def stage_times_ms(self) -> dict[str, float]:
        """Milliseconds of the last call's stages."""

    @property
    def block_evaluations(self) -> int:
        """How often the last forward or step composited a splat on a 4x4 block of pixels."""
