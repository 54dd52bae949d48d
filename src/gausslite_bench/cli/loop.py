"""`gausslite bench loop`: one robot's whole loop on a sequence, its time, its memory, and what the rate costs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from gausslite.cli.map_inputs import choose_estimator
from gausslite.cli.progress import MappingBar
from gausslite.cli.source_options import add_regions, open_with_warnings, selected_regions
from gausslite.config.mapping_options import add_budget, add_detector, add_policy, mission_settings
from gausslite.config.source_options import add_frames
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.evaluation.views import HeldOutView
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import TASK
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_stream import FrameStream
from gausslite.mission.results import as_text, peak_rss_mib
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer
from gausslite_bench.loop.frame_costs import CostLog, FrameCost, Latency, LoopBench, LoopTiming, Overhead
from gausslite_bench.loop.memory import MemoryTrend, back_and_forth, resident_mib
from gausslite_bench.loop.rate_gap import RateGap

_HOME = "sim:home?seed=0&trajectory=0"
_HOME_TASK = "Pick up the mug on the table"
_MEMORY_SAMPLES = 40


def configure_loop(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite bench loop`."""
    parser.add_argument("source", metavar="SOURCE", nargs="?", default=_HOME, help="as in map (default: %(default)s)")
    add_frames(parser, allow_auto=True)
    parser.add_argument("--task", metavar="TEXT", help=f'as in map (on the default source "{_HOME_TASK}")')
    add_detector(parser)
    add_regions(parser)
    add_policy(parser)
    add_budget(parser)
    add = parser.add_argument_group("benchmark").add_argument
    add("--loop", metavar="N", type=int, help="map N frames, the sequence back and forth, and watch the memory")
    add(
        "--unlimited",
        metavar="N",
        type=int,
        help="also map with N iterations a frame and compare ROI PSNR; every 8th frame is held out",
    )
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_loop)


def run_loop(options: argparse.Namespace) -> int:
    """Map the sequence with a clock between the steps and print the figures. Reading frames is not counted."""
    if options.source == _HOME and options.policy in (None, TASK) and not _says_what_matters(options):
        options.task = _HOME_TASK
    if options.loop is not None and options.loop < 2:
        raise InvalidInputError(f"--loop: expected at least 2 frames, got {options.loop}")
    source, _ = open_with_warnings(options.source, options.up, options.register_depth)
    positions: Sequence[int] = select_frames(source, options.frames)
    held_out: Sequence[int] = ()
    if options.unlimited is not None:
        positions, held_out = HeldOutSplit().split(positions)
        _check_gap(options, source, held_out)
    size = frame_size(options.size, source)
    mapped = [positions[step] for step in back_and_forth(len(positions), options.loop or len(positions))]
    rasterizer = choose_rasterizer(options.rasterizer, options.threads)
    bench, costs, memory = _play(options, source, mapped, rasterizer)
    timing = LoopTiming.of(costs)
    gap = None if options.unlimited is None else _gap(options, source, positions, held_out, bench)
    findings = _Findings(timing, Overhead.of(costs, rasterizer), gap, memory, len(mapped) - len(costs))
    print(as_text(findings.report(options, size)) if options.json else findings.lines(options.source, size))
    return 0


@dataclass(frozen=True, slots=True)
class _Findings:
    """What a run showed, for scripts and for people."""

    timing: LoopTiming
    overhead: Overhead | None
    gap: RateGap | None
    memory: MemoryTrend | None
    frames_skipped: int

    def report(self, options: argparse.Namespace, size: tuple[int, int]) -> dict[str, object]:
        """The figures under the names that scripts read."""
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

    def lines(self, name: str, size: tuple[int, int]) -> str:
        """The figures as one reads them."""
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
        f"  ROI PSNR on {gap.views} held-out views: {gap.in_time_db:.2f} dB; with {gap.iterations} iterations a "
        f"frame {gap.unlimited_db:.2f} dB, gap {gap.gap_db:.2f} dB"
    )


def _memory_line(memory: MemoryTrend) -> str:
    return (
        f"  memory {memory.start_mib:.0f}, {memory.middle_mib:.0f}, {memory.end_mib:.0f} MiB at the start, middle "
        f"and end; {memory.mib_per_1000_frames:+.2f} MiB per 1000 frames over the second half"
    )


def _play(
    options: argparse.Namespace, source: Source, positions: Sequence[int], rasterizer: Rasterizer
) -> tuple[LoopBench, list[FrameCost], MemoryTrend | None]:
    """Run the loop over these positions; memory is sampled where the sequence is looped."""
    settings, size = mission_settings(options), frame_size(options.size, source)
    mapper = GaussianMapper(settings.mapper_settings(), rasterizer, settings.seed)
    bench = LoopBench(choose_estimator(options, source), mapper, VoxelGrid(), settings.scheduler_settings)
    log, samples_mib = CostLog(), []
    every = max(1, len(positions) // _MEMORY_SAMPLES)
    done = 0

    def record(outcome: FrameOutcome) -> None:
        nonlocal done
        done += 1
        if outcome.skipped is None:
            log.append(FrameCost.of(outcome))
        bar.count(outcome)
        if options.loop is not None and (done % every == 0 or done == 1):
            samples_mib.append(resident_mib())

    with MappingBar(len(positions), "bench") as bar:
        bench.run(FrameStream(source, positions, size).frames(), record)
    return bench, log.costs(), MemoryTrend.of(samples_mib, every) if options.loop is not None else None


def _gap(
    options: argparse.Namespace, source: Source, positions: Sequence[int], held_out: Sequence[int], bench: LoopBench
) -> RateGap:
    """Map the same frames again with counted iterations and score both maps where neither was trained."""
    size = frame_size(options.size, source)
    in_time = bench.gaussians()
    patient = _patient(options)
    loop = LoopBench(choose_estimator(patient, source), build_mapper(mission_settings(patient)), VoxelGrid())
    with MappingBar(len(positions), "unlimited") as bar:
        loop.run(FrameStream(source, positions, size).frames(), bar.count)
    regions = selected_regions(options, source)
    views = [HeldOutView.of(source.frame(position, size), regions) for position in held_out]
    rasterizer = choose_rasterizer(options.rasterizer, options.threads)
    return RateGap.of(in_time, loop.gaussians(), options.unlimited, views, rasterizer)


def _patient(options: argparse.Namespace) -> argparse.Namespace:
    return argparse.Namespace(**{**vars(options), "rate": None, "iterations": options.unlimited})


def _check_gap(options: argparse.Namespace, source: Source, held_out: Sequence[int]) -> None:
    """Say before two runs what would leave nothing to compare after them. Raises InvalidInputError, DatasetError."""
    mission_settings(_patient(options))
    if not held_out:
        raise InvalidInputError("--unlimited: expected at least 8 frames, so that one is held out; got fewer")
    regions, size = selected_regions(options, source), frame_size(options.size, source)
    if not regions:
        raise InvalidInputError(
            "--unlimited: expected regions to score, with --roi FILE.npz, --objects A,B or --roi-ball X,Y,Z,R; got none"
        )
    if not any(HeldOutView.of(source.frame(position, size), regions).shows_region for position in held_out):
        raise InvalidInputError("--unlimited: expected a held-out frame that shows the region, got none")


def _says_what_matters(options: argparse.Namespace) -> bool:
    return bool(options.task or options.roi or options.objects or options.roi_ball)


def overhead_line(overhead: Overhead) -> str:
    """How much of the iterations' time the kernels do not have."""
    parts = (("full images", overhead.full_image), ("the region", overhead.region))
    apart = ", ".join(f"on {name} {share:.1f} %" for name, share in parts if share is not None)
    return f"  {overhead.all:.1f} % of the time of iterations is spent outside the kernels: {apart}"


def loop_lines(timing: LoopTiming) -> str:
    """The figures of a run, one kind a line."""

    def percentiles(name: str, latency: Latency) -> str:
        values = (latency.p50_ms, latency.p90_ms, latency.p99_ms, latency.max_ms)
        return f"  {name:<12}" + "".join(f"{value:9.1f}" for value in values)

    return "\n".join(
        [
            f"  {timing.frames} frames, {timing.hz:.2f} Hz, {timing.iterations_mean:.1f} iterations a frame "
            f"(at least {timing.iterations_min}), {timing.gaussians} Gaussians, ROI {timing.roi_share:.1%}",
            f"  {'ms':<12}" + "".join(f"{name:>9}" for name in ("p50", "p90", "p99", "max")),
            percentiles("frame", timing.latency),
            percentiles("perception", timing.perception),
            percentiles("mapping", timing.mapping),
            percentiles("ROI words", timing.words),
            *(percentiles(f" {name}", latency) for name, latency in timing.steps.items()),
            f"  {timing.frames_short} frames trained too little; for want of time went without "
            + ", ".join(f"{name}: {count}" for name, count in timing.skipped_stages.items()),
        ]
    )
