"""`gausslite bench team`: quality of fused maps, and what the agents send for it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.config.option import build, option
from gausslite.datasets.open import sequences_among
from gausslite.datasets.regions import REGIONS_FILE
from gausslite.mapping.policies import POLICIES
from gausslite.mission.results import prepare_folder
from gausslite.mission.settings import MissionSettings
from gausslite_bench.cli.study_options import (
    DEFAULT_HOME_FRAMES,
    DEFAULT_SIZE,
    StudyOptions,
    one_or_more,
    real_sequence_plans,
    study_command,
    write_results,
)
from gausslite_bench.quality.real_scenes import RealScenePlan
from gausslite_bench.team.bench import TeamResult, TeamTrial, run_trial
from gausslite_bench.team.scenes import HomeTeamPlan, RecordingTeamPlan, TeamPlan
from gausslite_bench.team.tables import team_table


@dataclass(frozen=True, slots=True)
class TeamOptions:
    """The options of `bench team` beside those of all studies."""

    homes: tuple[int, ...] = option((), "homes 1-8 (default: 1 without --real)", metavar="N,...", convert=one_or_more())
    team_sizes: tuple[int, ...] = option((2,), "numbers of agents, 2 to 4", metavar="N,...", convert=one_or_more())
    policies: tuple[str, ...] = option(
        ("task", "uniform", "splatam", "monogs", "gaussian-slam"),
        "policies",
        metavar="A,B",
        convert=one_or_more(POLICIES),
    )
    seeds: tuple[int, ...] = option((0,), "mapping seeds", metavar="N,...", convert=one_or_more())
    views: int = option(16, "held-out views", low=1, high=10_000)
    refine_iterations: int = option(300, "joint refinement; 0: none", low=0)


def run_team(options: argparse.Namespace) -> int:
    """Run the trials; the files are rewritten after each, so that an interrupt loses one trial at most."""
    plans, size = _plans(options)
    trials = [(plan, _trials(options, plan)) for plan in plans]
    prepare_folder(options.out)
    results: list[TeamResult] = []
    with progress_bar(sum(len(plan_trials) for _, plan_trials in trials), "team", "trial") as bar:
        for plan, plan_trials in trials:
            scene = plan.load(size)
            for trial in plan_trials:
                results.append(run_trial(trial, scene))
                bar.update()
                report = write_results(
                    options.out, "team", team_table(results), [result.as_json() for result in results]
                )
                print_above_bar(team_table(results[-1:]).splitlines()[-1])
    print(report if options.json else team_table(results))
    return 0


def _plans(options: argparse.Namespace) -> tuple[list[TeamPlan], tuple[int, int]]:
    """Return the teams in homes and in a recording, and the image size. Raises InvalidInputError, DatasetError."""
    chosen, team = build(StudyOptions, options), build(TeamOptions, options)
    frames = DEFAULT_HOME_FRAMES if chosen.frames is None else chosen.frames
    homes = team.homes or ((1,) if options.real is None else ())
    plans: list[TeamPlan] = [
        HomeTeamPlan(home, agents, frames, team.views) for home in homes for agents in team.team_sizes
    ]
    robots = _robots_plans(options, chosen.frames)
    if robots:
        kinds, size = robots[0]
        plans.append(RecordingTeamPlan(tuple(kinds), len(robots), tuple(own[0] for own, _ in robots)))
        return plans, chosen.size or size
    real = real_sequence_plans(options, None)
    if real is None:
        return plans, chosen.size or DEFAULT_SIZE
    kinds, size = real
    for agents in team.team_sizes:
        of_all = None if chosen.frames is None else agents * chosen.frames
        plans.append(RecordingTeamPlan(tuple(replace(kind, frames=of_all) for kind in kinds), agents))
    return plans, chosen.size or size


def _robots_plans(options: argparse.Namespace, frames: int | None) -> list[tuple[list[RealScenePlan], tuple[int, int]]]:
    """Return the plans and the image size of each robot, if the folder holds several recordings; empty otherwise."""
    inside = sequences_among(options.real.iterdir()) if options.real is not None and options.real.is_dir() else []
    if len(inside) < 2:
        return []
    regions = options.roi or options.real / REGIONS_FILE
    robots = [argparse.Namespace(**{**vars(options), "real": path, "roi": regions}) for _, path in inside]
    return [plans for robot in robots if (plans := real_sequence_plans(robot, frames)) is not None]


def _trials(options: argparse.Namespace, plan: TeamPlan) -> list[TeamTrial]:
    """Return the trials of one scene; invalid names and numbers fail here. Raises InvalidInputError."""
    chosen, team = build(StudyOptions, options), build(TeamOptions, options)
    return [
        TeamTrial(
            plan=plan,
            settings=MissionSettings(
                policy=name,
                max_gaussians=chosen.max_gaussians,
                iterations=chosen.iterations,
                seed=seed,
                threads=chosen.threads,
                pose_prior=plan.pose_prior,
            ),
            refine_iterations=team.refine_iterations,
        )
        for name in team.policies
        for seed in team.seeds
    ]


def configure_team(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench team`."""
    study_command(run_team, TeamOptions)(parser)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
