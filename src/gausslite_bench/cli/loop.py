"""`gausslite bench loop`: time and memory of an agent's mapping loop, and the quality lost to its frame rate."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from gausslite.cli.map_inputs import mission_settings, parse_task
from gausslite.cli.progress import MappingBar
from gausslite.cli.source_options import (
    RecordingOptions,
    calibrate_with_messages,
    open_recorded,
    selected_regions,
    stated_values,
)
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.program import Program
from gausslite.datasets.source import HeldOutSplit, Source, frame_size, select_frames
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import TASK
from gausslite.mission.build import EstimatorFactory, build_mapper, region_estimator
from gausslite.mission.results import as_text, peak_rss_mib
from gausslite.mission.runner import FrameStream
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    SceneInfo,
    SourceSettings,
    TaskSettings,
)
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.perception.relevance import RelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer
from gausslite_bench.loop.frame_costs import CostLog, FrameCost, Latency, LoopBench, LoopTiming, Overhead
from gausslite_bench.loop.memory import MemoryTrend, back_and_forth, resident_mib
from gausslite_bench.loop.rate_gap import RateGap
from gausslite_evaluation.views import HeldOutView

_HOME = "sim:home?seed=0&trajectory=0"
_HOME_TASK = "Pick up the mug on the table"
_MEMORY_SAMPLES = 40


@dataclass(frozen=True, slots=True)
class LoopOptions:
    """The options of `bench loop` beside those of `gausslite map`."""

    loop: int | None = option(None, "map N frames, back and forth along the sequence, and sample the memory", low=2)
    unlimited: int | None = option(
        None, "also map with N iterations per frame and compare ROI PSNR; every 8th frame is held out", low=1
    )
    json: bool = option(False, "print JSON for scripts")


def configure_loop(parser: CommandParser) -> None:
    """Add the options of `bench loop`."""
    Program.of(
        *(LoopOptions, RecordingOptions, SourceSettings, TaskSettings, PerceptionSettings, MissionSettings),
        flags="frames size task detector roi objects policy max-gaussians iterations rate seed loop unlimited json",
        positional="source",
        omit=("test-every",),
        defaults={"source": _HOME},
    ).add_to(parser)
    parser.set_defaults(run=run_loop)


def run_loop(options: argparse.Namespace) -> int:
    """Map the sequence and print the time of each stage. Reading frames is not counted."""
    if options.source == _HOME and options.policy == TASK and not _has_task(options):
        options.task = _HOME_TASK
    stated = stated_values(options.register_depth, options.camera_correction, options.pose_prior)
    calibration = calibrate_with_messages(options.source, open_recorded(options.source, options.up), stated)
    source, options.pose_prior = calibration.source, calibration.pose_prior
    positions: Sequence[int] = select_frames(source, options.frames)
    held_out: Sequence[int] = ()
    if options.unlimited is not None:
        positions, held_out = HeldOutSplit().split(positions)
        _check_gap(options, source, held_out)
    size = frame_size(options.size, source)
    mapped = [positions[step] for step in back_and_forth(len(positions), options.loop or len(positions))]
    rasterizer = choose_rasterizer(options.rasterizer, options.threads)
    bench, costs, memory = _run_mapping(options, source, mapped, rasterizer)
    timing = LoopTiming.of(costs)
    gap = None if options.unlimited is None else _gap(options, source, positions, held_out, bench)
    report = _Report(timing, Overhead.of(costs, rasterizer), gap, memory, len(mapped) - len(costs))
    print(as_text(report.as_json(options, size)) if options.json else report.as_lines(options.source, size))
    return 0


@dataclass(frozen=True, slots=True)
class _Report:
    """Results of a run as JSON or as text."""

    timing: LoopTiming
    overhead: Overhead | None
    gap: RateGap | None
    memory: MemoryTrend | None
    frames_skipped: int

    def as_json(self, options: argparse.Namespace, size: tuple[int, int]) -> dict[str, object]:
        """Return the results as one JSON object."""
        overhead, gap = self.overhead, self.gap
        return {
            "source": options.source,
            "task": options.task,
            "size": list(size),
            "rate": options.rate,
            **asdict(self.timing),
            "frames_skipped": self.frames_skipped,
            "overhead_percent": None if overhead is None else overhead.all,
            "overhead_full_image_percent": None if overhead is None else overhead.full_image,
            "overhead_region_percent": None if overhead is None else overhead.region,
            "memory": None if self.memory is None else asdict(self.memory),
            "rate_gap": None if gap is None else {**asdict(gap), "gap_db": gap.gap_db},
            "peak_rss_mib": peak_rss_mib(),
        }

    def as_lines(self, name: str, size: tuple[int, int]) -> str:
        """Return the results as lines of text."""
        lines = [f"{name} at {size[0]}x{size[1]}", loop_lines(self.timing)]
        if self.overhead is not None:
            lines.append(overhead_line(self.overhead))
        if self.gap is not None:
            lines.append(_gap_line(self.gap))
        if self.memory is not None:
            lines.append(_memory_line(self.memory))
        return "\n".join([*lines, f"  peak memory {peak_rss_mib():.0f} MiB"])


def _gap_line(gap: RateGap) -> str:
    return (
        f"  ROI PSNR on {gap.views} held-out views: {gap.in_time_db:.2f} dB; with {gap.iterations} iterations per "
        f"frame {gap.unlimited_db:.2f} dB, gap {gap.gap_db:.2f} dB"
    )


def _memory_line(memory: MemoryTrend) -> str:
    return (
        f"  memory {memory.start_mib:.0f}, {memory.middle_mib:.0f}, {memory.end_mib:.0f} MiB at the start, middle "
        f"and end; {memory.mib_per_1000_frames:+.2f} MiB per 1000 frames over the second half"
    )


def _estimator(options: argparse.Namespace, source: Source) -> RelevanceEstimator:
    """Return the relevance estimator of the options: for a task, for regions, or for a uniform map."""
    graph = parse_task(options)
    if graph is None:
        return region_estimator(selected_regions(options, source))
    return EstimatorFactory(
        build(PerceptionSettings, options).at_rate(mission_settings(options)), lambda: SceneInfo.of(source)
    ).build(graph)


def _run_mapping(
    options: argparse.Namespace, source: Source, positions: Sequence[int], rasterizer: Rasterizer
) -> tuple[LoopBench, list[FrameCost], MemoryTrend | None]:
    """Return the loop after these positions, the cost of each frame, and with --loop the memory trend."""
    settings, size = mission_settings(options), frame_size(options.size, source)
    mapper = GaussianMapper(settings.mapper_settings(), rasterizer, settings.seed)
    bench = LoopBench(_estimator(options, source), mapper, VoxelGrid(), settings.scheduler_settings)
    log = CostLog()
    samples_mib: list[float] = []
    sample_interval = max(1, len(positions) // _MEMORY_SAMPLES)
    done = 0

    def record(outcome: FrameOutcome) -> None:
        nonlocal done
        done += 1
        if outcome.skipped is None:
            log.append(FrameCost.of(outcome))
        bar.count(outcome)
        if options.loop is not None and (done % sample_interval == 0 or done == 1):
            samples_mib.append(resident_mib())

    with MappingBar(len(positions), "bench") as bar:
        bench.run(FrameStream(source, positions, size).frames(), record)
    trend = MemoryTrend.of(samples_mib, sample_interval) if options.loop is not None else None
    return bench, log.costs(), trend


def _gap(
    options: argparse.Namespace, source: Source, positions: Sequence[int], held_out: Sequence[int], bench: LoopBench
) -> RateGap:
    """Map the same frames again with --unlimited iterations and score both maps on the held-out frames."""
    size = frame_size(options.size, source)
    unlimited = _without_rate(options)
    loop = LoopBench(_estimator(unlimited, source), build_mapper(mission_settings(unlimited)), VoxelGrid())
    with MappingBar(len(positions), "unlimited") as bar:
        loop.run(FrameStream(source, positions, size).frames(), bar.count)
    regions = selected_regions(options, source)
    views = [HeldOutView.of(source.frame(position, size), regions) for position in held_out]
    rasterizer = choose_rasterizer(options.rasterizer, options.threads)
    return RateGap.of(bench.gaussians(), loop.gaussians(), options.unlimited, views, rasterizer)


def _without_rate(options: argparse.Namespace) -> argparse.Namespace:
    return argparse.Namespace(**{**vars(options), "rate": None, "iterations": options.unlimited})


def _check_gap(options: argparse.Namespace, source: Source, held_out: Sequence[int]) -> None:
    """Check before two runs that their maps can be compared. Raises InvalidInputError, DatasetError."""
    mission_settings(_without_rate(options))
    if not held_out:
        raise InvalidInputError("--unlimited: expected at least 8 frames, so that one is held out; got fewer")
    regions, size = selected_regions(options, source), frame_size(options.size, source)
    if not regions:
        raise InvalidInputError(
            "--unlimited: expected regions to score, with --roi FILE.npz, --objects A,B or --target-at X,Y,Z; got none"
        )
    if not any(HeldOutView.of(source.frame(position, size), regions).shows_region for position in held_out):
        raise InvalidInputError("--unlimited: expected a held-out frame that shows the region, got none")


def _has_task(options: argparse.Namespace) -> bool:
    return bool(options.task or options.roi or options.objects or options.target_at)


def overhead_line(overhead: Overhead) -> str:
    """Return the share of the iterations' time outside the kernels as text."""
    parts = (("full images", overhead.full_image), ("the region", overhead.region))
    details = ", ".join(f"{name} {percent:.1f} %" for name, percent in parts if percent is not None)
    return f"  {overhead.all:.1f} % of the iterations' time is spent outside the kernels: {details}"


def loop_lines(timing: LoopTiming) -> str:
    """Return the statistics of a run as lines of text."""

    def percentiles(name: str, latency: Latency) -> str:
        values = (latency.p50_ms, latency.p90_ms, latency.p99_ms, latency.max_ms)
        return f"  {name:<12}" + "".join(f"{value:9.1f}" for value in values)

    return "\n".join(
        [
            f"  {timing.frames} frames, {timing.hz:.2f} Hz, {timing.iterations_mean:.1f} iterations per frame "
            f"(minimum {timing.iterations_min}), {timing.gaussians} Gaussians, ROI {timing.roi_share:.1%}",
            f"  {'ms':<12}" + "".join(f"{name:>9}" for name in ("p50", "p90", "p99", "max")),
            percentiles("frame", timing.latency),
            percentiles("perception", timing.perception),
            percentiles("mapping", timing.mapping),
            percentiles("publishing", timing.publishing),
            *(percentiles(f" {name}", latency) for name, latency in timing.stages.items()),
            f"  {timing.frames_under_trained} frames under-trained; frames that skipped a stage for lack of time: "
            + ", ".join(f"{name}: {count}" for name, count in timing.skipped_stages.items()),
        ]
    )
