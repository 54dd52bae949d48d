"""Type stubs of the native extension (native/src/bindings.cpp); use gausslite.render.cpu.CpuRasterizer."""

from collections.abc import Sequence

from jaxtyping import Bool, Float32, Float64, UInt8, UInt32
from numpy import ndarray

def usable_simd() -> list[str]:
    """Return the instruction sets of this build that this machine runs, fastest first."""

def core_clock_ghz() -> float:
    """Measure the clock of the current core in GHz."""

class View:
    """A training image in tiles, with its weights."""

    def __init__(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        pixel_weights: Float32[ndarray, "h w"] | None,
    ) -> None: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...

class StepScene:
    """View, camera, tiles and ids of a step; references the arrays."""

    def __init__(
        self,
        view: View,
        intrinsics: tuple[float, float, float, float, int, int],
        T_camera_world: Float64[ndarray, "4 4"],
        tiles: Bool[ndarray, "th tw"] | None,
        ids: UInt32[ndarray, " m"] | None,
        motion: list[float] | None,
        dilation_px2: float,
    ) -> None: ...

class StepTraining:
    """Tables, settings and counter of a step; references the arrays."""

    def __init__(
        self,
        tables: tuple[Float32[ndarray, "n 16"], Float32[ndarray, "n 16"], Float32[ndarray, "n 16"]],
        loss: tuple[float, float, float, bool],
        rates: Sequence[float],
        adam: tuple[float, float, float, float],
        masked: bool,
        update_counts: UInt32[ndarray, " n"] | None,
        count_mask: Bool[ndarray, " n"] | None,
        binding_id: int,
    ) -> None:
        """Store the arguments. loss: colour, depth, ssim, normalise_by_image. adam: beta1, beta2, epsilon,
        decay_after_updates.

        update_counts increases by 1 for each changed row that count_mask selects. binding_id: number of the table
        binding, in which only steps change the rows; 0: not bound.
        """

class Engine:
    """Scratch memory and a thread pool; it does not own the splats."""

    def __init__(self, simd: str, threads: int) -> None: ...
    @property
    def threads(self) -> int: ...
    @property
    def frame(self) -> int:
        """Number of the latest forward or step."""

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        intrinsics: tuple[float, float, float, float, int, int],
        T_camera_world: Float64[ndarray, "4 4"],
        tiles: Bool[ndarray, "th tw"] | None,
        ids: UInt32[ndarray, " m"] | None,
        motion: list[float] | None,
        dilation_px2: float,
    ) -> tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w"], Float32[ndarray, "h w"], int]:
        """Return rgb, depth_m, alpha and the frame number.

        intrinsics: fx, fy, cx, cy, width, height. motion: linear and angular velocity, readout and exposure time.
        """

    def backward(
        self,
        frame: int,
        row_count: int,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> tuple[Float32[ndarray, "n 16"], Float64[ndarray, "6"], UInt32[ndarray, " m"], Float32[ndarray, " m"]]:
        """Return d_rows, d_twist, visible rows and mean_2d_grad_norm."""

    def step(self, scene: StepScene, training: StepTraining) -> float:
        """Run one training iteration and return the loss."""

    def visible(self) -> UInt32[ndarray, " m"]:
        """Return the visible rows of the last forward or step, ascending."""

    @property
    def steps_ms(self) -> float:
        """Total milliseconds of all steps."""

    @property
    def masked_steps_ms(self) -> float:
        """Total milliseconds of the masked steps."""

    def stage_times_ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage of the last call."""

    @property
    def block_evaluations(self) -> int:
        """Number of pairs of a splat and a 4x4 pixel block that the last forward or step composited."""
