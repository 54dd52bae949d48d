"""`gausslite bench team`: quality of fused maps, what the agents send for it, late robots, and object positions."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.plain_values import split_names
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.voxels import VoxelGrid, group_by_voxel
from gausslite.mapping.policies import POLICIES
from gausslite.mission.results import as_text, prepare_folder, write_json
from gausslite.mission.settings import MissionSettings, PerceptionSettings
from gausslite_bench.cli.argument_types import read_image_size, read_seeds
from gausslite_bench.cli.study_options import add_real_sequence, real_sequence_plans
from gausslite_bench.team.bench import TeamResult, TeamTrial, run_trial
from gausslite_bench.team.frame_errors import FrameError
from gausslite_bench.team.frame_pairs import judge_pairs, pairs_table
from gausslite_bench.team.late_joiner import late_joiner_table, run_late_joiner
from gausslite_bench.team.missions import AgentMap, map_agent
from gausslite_bench.team.object_positions import PositionScore, measure_positions, positions_table
from gausslite_bench.team.scenes import HomeTeamPlan, RecordingTeamPlan, TeamPlan
from gausslite_bench.team.tables import team_table
from gausslite_bench.team.unknown_frames import search_frames, searches_table
from gausslite_places.frame_fit import SurfaceSamples

_SIZE = (320, 240)
_HOME_FRAMES = 60


def configure_team(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench team`."""
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, required=True, help="folder for team.md and team.json")
    add("--homes", metavar="N,...", type=split_names, help="homes, 1 to 8 (default: 1, or none with --real)")
    add(
        "--team-sizes", metavar="N,...", type=split_names, default=("2",), help="numbers of agents, 2 to 4 (default: 2)"
    )
    add(
        "--policies",
        metavar="A,B",
        type=split_names,
        default=("task", "uniform", "splatam", "monogs", "gaussian-slam"),
        help="policies (default: task and the four baselines)",
    )
    add("--seeds", metavar="N,...", type=read_seeds, default=(0,), help="mapping seeds (default: 0)")
    add(
        "--size",
        metavar="WxH",
        type=read_image_size,
        help="image size (default: 320x240; recordings keep their aspect)",
    )
    add("--frames", metavar="N", type=int, help="frames of each agent (default: 60 in a home, all of a recording)")
    add("--views", metavar="N", type=int, default=16, help="held-out views (default: %(default)s)")
    add("--max-gaussians", metavar="N", type=int, default=60_000, help="hard cap of each agent (default: %(default)s)")
    add("--iterations", metavar="N", type=int, default=8, help="iterations per frame (default: %(default)s)")
    add(
        "--refine-iterations",
        metavar="N",
        type=int,
        default=300,
        help="joint refinement; 0: none (default: %(default)s)",
    )
    add(
        "--frame-error",
        metavar="M,DEG,DRIFT",
        type=_read_frame_error,
        default=FrameError(),
        help="shift, turn and drift (share of the way) of all agents' frames except the first's (default: none)",
    )
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    parser.add_argument(
        "--late-joiner", action="store_true", help="only measure a robot that joins late, alone and with the team's map"
    )
    parser.add_argument(
        "--positions",
        action="store_true",
        help="only measure where perception places the objects of the first agent's task",
    )
    parser.add_argument(
        "--frame-pairs",
        metavar="N",
        type=int,
        help="only judge N pairs of parts of the agents' maps, half of them in wrong frames, as the server does",
    )
    parser.add_argument(
        "--unknown-frames",
        metavar="N",
        type=int,
        help="only search N unknown frames of each kind of map, with any yaw and up to 10 m away, as the server does",
    )
    add(
        "--detector",
        metavar="FILE.onnx",
        type=Path,
        help="detector of --positions (default: exact masks of the ground truth)",
    )
    add_real_sequence(parser)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_team)


def run_team(options: argparse.Namespace) -> int:
    """Run the trials; the files are rewritten after each, so that an interrupt loses one trial at most."""
    counts = {"--frame-pairs": options.frame_pairs, "--unknown-frames": options.unknown_frames}
    given = {name: count for name, count in counts.items() if count is not None}
    if options.late_joiner + options.positions + len(given) > 1:
        raise InvalidInputError(f"--late-joiner, --positions, {', '.join(counts)}: expected one of them, got several")
    for name, count in given.items():
        if count < 1:
            raise InvalidInputError(f"{name}: expected at least 1, got {count}")
    if options.detector is not None and not options.positions:
        raise InvalidInputError("--detector: expected --positions, which uses it; other trials have exact masks")
    plans, size = _plans(options)
    if options.positions:
        return _run_positions(options, plans, size)
    trials = [(plan, _trials(options, plan, size)) for plan in plans]
    prepare_folder(options.out)
    if options.late_joiner:
        return _run_late_joiner(options, trials)
    if options.frame_pairs is not None:
        return _run_frame_pairs(options, trials)
    if options.unknown_frames is not None:
        return _run_unknown_frames(options, trials)
    results: list[TeamResult] = []
    with progress_bar(0, "team", "frame") as bar:
        for plan, plan_trials in trials:
            scene = plan.load(size)
            _expect(bar, len(plan_trials) * sum(len(agent.frames) for agent in scene.agents))
            for trial in plan_trials:
                results.append(run_trial(trial, scene, lambda _: _count(bar)))
                _write(options.out, results)
                print_above_bar(team_table(results[-1:]).splitlines()[-1])
    print(as_text({"trials": [result.as_json() for result in results]}) if options.json else team_table(results))
    return 0


def _expect(bar: tqdm[Any], frames: int) -> None:
    bar.total = (bar.total or 0) + frames


def _count(bar: tqdm[Any]) -> None:
    bar.update()


def _run_late_joiner(options: argparse.Namespace, trials: Sequence[tuple[TeamPlan, Sequence[TeamTrial]]]) -> int:
    """Measure each scene, policy and seed; write late-joiner.md and .json."""
    results = []
    for trial in (trial for _, plan_trials in trials for trial in plan_trials):
        results.append(run_late_joiner(trial.plan, trial.settings, trial.size, trial.grid))
        print_above_bar(results[-1].row)
    _write_table(options, "late-joiner", late_joiner_table(results), [asdict(result) for result in results])
    return 0


def _run_frame_pairs(options: argparse.Namespace, trials: Sequence[tuple[TeamPlan, Sequence[TeamTrial]]]) -> int:
    """Map every scene once, judge pairs of parts of its first two maps; write frame-pairs.md and .json."""
    grid = trials[0][1][0].grid
    maps = [(_samples(first, grid), _samples(second, grid)) for _, first, second in _first_two_maps(trials)]
    pairs = judge_pairs(maps, options.frame_pairs, options.seeds[0])
    _write_table(options, "frame-pairs", pairs_table(pairs), [asdict(pair) for pair in pairs])
    return 0


def _run_unknown_frames(options: argparse.Namespace, trials: Sequence[tuple[TeamPlan, Sequence[TeamTrial]]]) -> int:
    """Map every scene once, search the second map in the first; write unknown-frames.md and .json."""
    scenes, grid = list(_first_two_maps(trials)), trials[0][1][0].grid
    searches = []
    for search in search_frames(scenes, options.unknown_frames, grid, options.seeds[0]):
        searches.append(search)
        print_above_bar(f"{search.scene}, {search.place}, {search.data}: {search.outcome} {search.reason}")
    _write_table(options, "unknown-frames", searches_table(searches), [asdict(search) for search in searches])
    return 0


def _first_two_maps(
    trials: Sequence[tuple[TeamPlan, Sequence[TeamTrial]]],
) -> Iterator[tuple[str, AgentMap, AgentMap]]:
    """Yield each scene's name and the maps of its first two agents."""
    with progress_bar(0, "maps", "frame") as bar:
        for plan, (trial, *_) in trials:
            agents = plan.load(trial.size).agents[:2]
            _expect(bar, sum(len(agent.frames) for agent in agents))
            first, second = (map_agent(agent, trial.settings, trial.grid, lambda _: _count(bar)) for agent in agents)
            yield plan.name, first, second


def _samples(agent: AgentMap, grid: VoxelGrid) -> SurfaceSamples:
    return SurfaceSamples.of(group_by_voxel(agent.gaussians, grid))


def _run_positions(options: argparse.Namespace, plans: Sequence[TeamPlan], size: tuple[int, int]) -> int:
    """Measure each scene; write positions.md and .json."""
    prepare_folder(options.out)
    perception = PerceptionSettings(options.detector, threads=options.threads)
    scores: list[PositionScore] = []
    with progress_bar(0, "positions", "frame") as bar:
        for plan in plans:
            scene = plan.load(size)
            _expect(bar, sum(len(agent.frames) for agent in scene.agents))
            scores += measure_positions(scene, perception, lambda: _count(bar))
    _write_table(options, "positions", positions_table(scores), [asdict(score) for score in scores])
    return 0


def _write_table(options: argparse.Namespace, name: str, table: str, scenes: list[dict[str, Any]]) -> None:
    command = shlex.join(["gausslite", *sys.argv[1:]])
    write_atomic(options.out / f"{name}.md", f"# bench team\n\n`{command}`\n\n{table}".encode())
    report = {"command": command, "scenes": scenes}
    write_json(options.out / f"{name}.json", report)
    print(as_text(report) if options.json else table)


def _plans(options: argparse.Namespace) -> tuple[list[TeamPlan], tuple[int, int]]:
    """Return the teams in homes and in a recording, and the image size. Raises InvalidInputError, DatasetError."""
    sizes = [_number("team-sizes", agents) for agents in options.team_sizes]
    # all agents look for the objects of the first task, so that one and several agents can be compared
    same_task = options.positions
    homes = ("1",) if options.homes is None and options.real is None else options.homes or ()
    plans: list[TeamPlan] = [
        HomeTeamPlan(
            _number("homes", home),
            agents,
            _HOME_FRAMES if options.frames is None else options.frames,
            options.views,
            same_task,
        )
        for home in homes
        for agents in sizes
    ]
    real = real_sequence_plans(options)
    if real is None:
        return plans, options.size or _SIZE
    kinds, size = real
    for agents in sizes:
        frames = None if options.frames is None else agents * options.frames
        parts = tuple(replace(kind, frames=frames) for kind in kinds)
        groups = [(kind,) for kind in parts] if same_task else [parts]
        plans += [RecordingTeamPlan(group, agents) for group in groups]
    return plans, options.size or size


def _trials(options: argparse.Namespace, plan: TeamPlan, size: tuple[int, int]) -> list[TeamTrial]:
    """Return the trials of one scene; invalid names and numbers fail here. Raises InvalidInputError."""
    unknown = [name for name in options.policies if name not in POLICIES]
    if unknown or not options.policies:
        raise InvalidInputError(
            f"policies: expected names among {', '.join(POLICIES)}, got {', '.join(unknown) or 'none'}"
        )
    policy = plan.pose_policy
    return [
        TeamTrial(
            plan=plan,
            policy=name,
            seed=seed,
            settings=MissionSettings(
                policy=name,
                max_gaussians=options.max_gaussians,
                iterations=options.iterations,
                seed=seed,
                threads=options.threads,
                pose_prior=options.pose_prior or policy.pose_prior,
            ),
            size=size,
            refine_iterations=options.refine_iterations,
            fit_views=policy.fit_views if options.fit_views is None else options.fit_views,
            frame_error=options.frame_error,
        )
        for name in options.policies
        for seed in options.seeds
    ]


def _number(name: str, text: str) -> int:
    if not text.isdecimal():
        raise InvalidInputError(f"--{name}: expected whole numbers, got {text!r}")
    return int(text)


def _read_frame_error(text: str) -> FrameError:
    try:
        shift_m, rotation_deg, drift = (float(part) for part in text.split(","))
        return FrameError(shift_m, rotation_deg, drift)
    except (ValueError, InvalidInputError):
        raise argparse.ArgumentTypeError(
            f"expected metres, degrees and a share such as 0.05,2,0, got {text!r}"
        ) from None


def _write(folder: Path, results: Sequence[TeamResult]) -> None:
    command = shlex.join(["gausslite", *sys.argv[1:]])
    write_atomic(folder / "team.md", f"# bench team\n\n`{command}`\n\n{team_table(results)}".encode())
    write_json(folder / "team.json", {"command": command, "trials": [result.as_json() for result in results]})
