"""`gausslite demo`: a team of two maps one place by task, and the fused map is scored against each robot alone."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType

from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.cli.source_options import open_recorded, register_with_warnings, resolve_pose_prior
from gausslite.cli.team import AgentPlan, Team, TeamPlan, agent_report, collect_maps, running_team, watch_missions
from gausslite.codec.ply import read_ply
from gausslite.config.mapping_options import (
    add_budget,
    add_detector,
    add_pose_prior,
    add_voxel_size,
    perception_settings,
)
from gausslite.config.source_options import add_register_depth
from gausslite.config.values import AUTO, read_names
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.domain.region import Region
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.evaluation.compare import MapScores
from gausslite.evaluation.pictures import write_png
from gausslite.evaluation.team import HeldOutFrames, TeamScores, score_team
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.mission.build import open_models
from gausslite.mission.results import prepare_folder, write_json
from gausslite.mission.settings import MissionSettings
from gausslite.perception.vocabulary import same_kind
from gausslite.render.choose import choose_rasterizer

_HOME = "sim:home?seed={seed}&trajectory={trajectory}&frames={frames}"
_HOME_FRAMES, _HOME_VIEWS = 120, 24
_HOME_SIZE = "320x240"
_HOLD_OUT = 8
_AGENT_KEYS = ("frames", "hz", "gaussians", "roi_share", "bytes_sent", "map_shared_percent")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite demo`."""
    parser.add_argument("--source", metavar="SOURCE", help="a sequence to share out (default: a simulated home)")
    parser.add_argument("--task-a", metavar="TEXT", default="Pick up the mug on the table", help="mission of agent-a")
    parser.add_argument(
        "--task-b", metavar="TEXT", default="Identify the chair closest to the table", help="mission of agent-b"
    )
    parser.add_argument("--frames-a", metavar="START:STOP:STEP", help="frames of agent-a (default: the first half)")
    parser.add_argument("--frames-b", metavar="START:STOP:STEP", help="frames of agent-b (default: the second half)")
    parser.add_argument(
        "--objects", metavar="A,B", type=read_names, default=(), help="score these (default: the tasks' nouns)"
    )
    parser.add_argument("--size", metavar="WxH", help=f"image size (default: as it is; {_HOME_SIZE} in the home)")
    add_register_depth(parser, allow_auto=True, default_text=AUTO)
    add_pose_prior(parser, AUTO, AUTO, allow_auto=True)
    add_voxel_size(parser)
    parser.add_argument("--refine-iterations", metavar="N", type=int, default=500, help="0 leaves refinement out")
    add_detector(parser)
    add_budget(parser)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="gets report.json, maps and pictures")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the team, score the maps, write and print the report."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    if not 0 <= options.refine_iterations <= MAX_REFINE_ITERATIONS:
        raise InvalidInputError(
            f"--refine-iterations: expected 0 to {MAX_REFINE_ITERATIONS}, got {options.refine_iterations}"
        )
    _require_usable(options)
    prepare_folder(options.out)
    stage = _simulated_stage(options) if options.source is None else _recorded_stage(options)
    with running_team(_plan(options, stage), options.out.absolute()) as team:
        watch_missions(team)
        maps = collect_maps(team, options.out)
        agents = _agents(team, options.out)
    scores = _score(options, stage, maps)
    report = {
        "source": options.source or stage.agents[0].source,
        "colour_camera": None if stage.depth_registration is None else str(stage.depth_registration),
        "view_error": None if stage.pose_prior.is_exact else str(stage.pose_prior),
        "size": list(stage.size),
        "seed": options.seed,
        "agents": agents,
        "maps": {name: asdict(score) for name, score in scores.scores.items()},
        "scored": {
            "objects": sorted(stage.regions),
            "views": next(iter(scores.scores.values())).n_views,
            "fitted": stage.fit_views,
        },
    }
    write_json(options.out / "report.json", report)
    _write_pictures(options.out / "pictures", scores)
    print(_table(agents, scores.scores, stage.fit_views))
    print(f"report, maps and pictures are in {options.out}")
    return 0


def _require_usable(options: argparse.Namespace) -> None:
    """Say before a home is built what every agent would say for itself. Raises InvalidInputError, ModelFileError."""
    MissionSettings(
        max_gaussians=options.max_gaussians,
        iterations=options.iterations,
        rate_hz=options.rate,
        min_iterations=options.min_iterations,
        skip_stages=options.skip_stages,
        deadline_slack=options.deadline_slack,
        seed=options.seed,
        threads=options.threads,
    )
    VoxelGrid(options.voxel_size)
    open_models(perception_settings(options))


@dataclass(frozen=True, slots=True, eq=False)
class _Stage:
    """Where the team works: the agents' cameras, the views kept from them, and what is scored in those."""

    agents: tuple[AgentPlan, ...]
    size: tuple[int, int]
    hold_out: int | None
    held_out: tuple[HeldOutFrames, ...]
    regions: Mapping[str, Region]
    depth_registration: DepthRegistration | None = None
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)

    @property
    def fit_views(self) -> bool:
        """Maps of refined views stand a little beside the poses that were said, and are judged like that."""
        return not self.pose_prior.is_exact


def _simulated_stage(options: argparse.Namespace) -> _Stage:
    """Two walks through one home; the held-out views lie off both."""
    if options.register_depth is not None:
        raise InvalidInputError("--register-depth: belongs to a recorded sequence; name it with --source")
    specs = [
        _HOME.format(seed=options.seed, trajectory=walk, frames=_HOME_VIEWS if walk == 2 else _HOME_FRAMES)
        for walk in range(3)
    ]
    walks = [(specs[0], options.task_a, options.frames_a), (specs[1], options.task_b, options.frames_b)]
    agents = tuple(
        AgentPlan(f"agent-{letter}", task, spec, frames or ":", len(select_frames(open_source(spec), frames or ":")))
        for letter, (spec, task, frames) in zip("ab", walks, strict=True)
    )
    held_out = open_source(specs[2])
    size = frame_size(options.size or _HOME_SIZE, held_out)
    return _Stage(
        agents,
        size,
        None,
        (HeldOutFrames(held_out, range(len(held_out)), size),),
        _scored_regions(options, held_out.regions()),
        pose_prior=resolve_pose_prior(specs[2], held_out, options.pose_prior),
    )


def _recorded_stage(options: argparse.Namespace) -> _Stage:
    """One sequence in two parts; every eighth frame of each is kept from mapping."""
    recorded = open_recorded(options.source, None)
    middle = recorded.indices()[len(recorded) // 2]
    first, second = options.frames_a or f":{middle}", options.frames_b or f"{middle}:"
    size, regions = frame_size(options.size, recorded), _scored_regions(options, recorded.regions())
    agents, held_out = [], []
    for letter, task, frames in (("a", options.task_a, first), ("b", options.task_b, second)):
        train, held = HeldOutSplit(_HOLD_OUT).split(select_frames(recorded, frames))
        agents.append(AgentPlan(f"agent-{letter}", task, str(options.source), frames, len(train)))
        held_out.append(held)
    source, camera = register_with_warnings(options.source, recorded, options.register_depth, AUTO)
    pose_prior = resolve_pose_prior(options.source, source, options.pose_prior)
    views = tuple(HeldOutFrames(source, held, size) for held in held_out)
    return _Stage(tuple(agents), size, _HOLD_OUT, views, regions, camera, pose_prior)


def _scored_regions(options: argparse.Namespace, regions: Mapping[str, Region]) -> dict[str, Region]:
    """The objects the tasks name, or the ones the user names. Raises InvalidInputError."""
    if options.objects:
        return dict(zip(options.objects, choose_regions(regions, options.objects), strict=True))
    from gausslite.task.rules import RuleParser

    targets = {t for task in (options.task_a, options.task_b) for t in RuleParser().parse(task).targets}
    chosen = {name: region for name, region in regions.items() if any(same_kind(target, name) for target in targets)}
    if not chosen:
        raise InvalidInputError(
            f"demo: expected ground truth for {', '.join(sorted(targets))} to score against, "
            f"got regions {', '.join(regions) or 'of nothing'}"
        )
    return chosen


def _plan(options: argparse.Namespace, stage: _Stage) -> TeamPlan:
    width, height = stage.size
    shared = ["--size", f"{width}x{height}", "--max-gaussians", str(options.max_gaussians), "--seed", str(options.seed)]
    shared += [
        "--threads",
        str(1 if options.threads is None else options.threads),
        "--voxel-size",
        str(options.voxel_size),
    ]
    if stage.hold_out is not None:
        shared += ["--test-every", str(stage.hold_out)]
    if stage.depth_registration is not None:
        shared += ["--register-depth", str(stage.depth_registration)]
    if not stage.pose_prior.is_exact:
        shared += ["--pose-prior", str(stage.pose_prior)]
    if options.detector is not None:
        shared += ["--detector", str(options.detector.absolute())]
    if options.resegment:
        shared += ["--resegment"]
    if options.segmenter is not None:
        shared += ["--segmenter", options.segmenter]
    if options.vocabulary is not None:
        shared += ["--vocabulary", str(options.vocabulary.absolute())]
    if options.rate is not None:
        shared += [
            "--rate",
            str(options.rate),
            "--min-iterations",
            str(options.min_iterations),
            "--skip-stages",
            ",".join(options.skip_stages),
        ]
        shared += ["--deadline-slack", str(options.deadline_slack)]
    if options.iterations is not None:
        shared += ["--iterations", str(options.iterations)]
    return TeamPlan(stage.agents, tuple(shared), options.voxel_size, options.refine_iterations, options.seed)


def _agents(team: Team, out: Path) -> dict[str, dict[str, object]]:
    agents = {}
    for plan in team.plan.agents:
        report = agent_report(out, plan.agent_id)
        agents[plan.agent_id] = {"task": plan.task, **{key: report[key] for key in _AGENT_KEYS}, **report}
    return agents


def _score(options: argparse.Namespace, stage: _Stage, maps: Mapping[str, Path]) -> TeamScores:
    gaussians = {name: read_ply(path) for name, path in maps.items()}
    rasterizer = choose_rasterizer(threads=options.threads)
    return score_team(gaussians, stage.held_out, list(stage.regions.values()), rasterizer, stage.fit_views)


def _write_pictures(folder: Path, scores: TeamScores) -> None:
    prepare_folder(folder)
    for name, sheet in scores.sheets.items():
        write_png(folder / f"{name}.png", sheet)


def _table(agents: Mapping[str, Mapping[str, object]], scores: Mapping[str, MapScores], fitted: bool) -> str:
    lines = ["", f"{'agent':<10}{'frames':>8}{'Hz':>8}{'Gaussians':>11}{'ROI':>8}{'sent':>11}{'shared':>9}"]
    for name, row in agents.items():
        lines.append(
            f"{name:<10}{row['frames']:>8}{row['hz']:>8.1f}{row['gaussians']:>11}{row['roi_share']:>8.1%}"
            f"{_number(row['bytes_sent']) / 1e6:>8.2f} MB{_number(row['map_shared_percent']):>8.1f}%"
        )
    lines += ["", f"{'map':<15}{'ROI PSNR':>10}{'ROI SSIM':>10}{'full PSNR':>11}"]
    for name, score in scores.items():
        roi_psnr = "-" if score.roi_psnr is None else f"{score.roi_psnr:.2f} dB"
        roi_ssim = "-" if score.roi_ssim is None else f"{score.roi_ssim:.3f}"
        lines.append(f"{name:<15}{roi_psnr:>10}{roi_ssim:>10}{score.full_psnr:>8.2f} dB")
    if fitted:
        lines.append("each held-out view's pose and colours fitted, as views were refined")
    return "\n".join(lines) + "\n"


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
