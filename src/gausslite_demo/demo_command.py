"""`gausslite demo`: two agents map one place for two tasks; the fused map is scored against each agent's own."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path

from gausslite.cli.map_command import mission_settings
from gausslite.codec.ply import read_ply
from gausslite.codec.state_file import write_png
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option, plain_options
from gausslite.config.plain_values import Plain
from gausslite.config.program import Program
from gausslite.config.values import VOXEL_SIZE, not_empty
from gausslite.datasets.open import default_world_frame
from gausslite.domain.checks import require_name
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.mission.build import chosen_detector
from gausslite.mission.recording import RecordingOptions
from gausslite.mission.results import REPORT_PAGE, prepare_folder, require_writable, write_json
from gausslite.mission.runner import CorruptFrames
from gausslite.mission.settings import MissionSettings, PerceptionSettings
from gausslite.pages import Pages, load_pages
from gausslite.process import print_message, size_text
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite.wire.channel import MAX_PORT
from gausslite_demo.services import (
    HOME_SIZE,
    AgentPlan,
    DemoPlan,
    Scenario,
    agent_report,
    collect_maps,
    recorded_scenario,
    remove_results,
    require_no_demo,
    running_services,
    simulated_scenario,
    watch_missions,
)
from gausslite_evaluation.compare import MAP_PURPOSES, TeamScores, score_team, team_sentence
from gausslite_evaluation.views import HeldOutView

_AGENT_KEYS = ("frames", "hz", "gaussians", "roi_share", "bytes_sent", "map_shared_percent")


def demo_report(
    options: argparse.Namespace,
    scenario: Scenario,
    agents: Mapping[str, object],
    result: TeamScores,
    frames_corrupt: int,
) -> dict[str, object]:
    """Return report.json of the demo. frames_corrupt: number of held-out frames that cannot be read."""
    registration, correction, prior = scenario.depth_registration, scenario.camera_correction, scenario.pose_prior
    return {
        "source": options.source or scenario.agents[0].source,
        "colour_camera": None if registration is None else str(registration),
        "camera_correction": None if correction is None else str(correction),
        "view_error": None if prior.is_exact else str(prior),
        "size": list(scenario.size),
        "seed": options.seed,
        "agents": dict(agents),
        "maps": {
            name: {**asdict(score), "tasks": {task: asdict(maps[name]) for task, maps in result.by_task.items()}}
            for name, score in result.scores.items()
        },
        "scored": {
            "objects": sorted(scenario.regions),
            "views": next(iter(result.scores.values())).n_views,
            "frames_corrupt": frames_corrupt,
            "fitted": scenario.fit_views,
        },
    }


def agent_reports(agents: tuple[AgentPlan, ...], out: Path) -> dict[str, dict[str, object]]:
    """Return the reports that the agents have written, with their tasks. Raises UnavailableError."""
    reports = {}
    for agent in agents:
        report = agent_report(out, agent.agent_id)
        reports[agent.agent_id] = {"task": agent.task, **{key: report[key] for key in _AGENT_KEYS}, **report}
    return reports


def report_tables(agents: Mapping[str, Mapping[str, object]], result: TeamScores, fitted_views: bool) -> str:
    """Return a table of the agents, a table of the maps' scores, and what each map is for, as text."""
    lines = ["", f"{'agent':<10}{'frames':>8}{'Hz':>8}{'Gaussians':>11}{'ROI':>8}{'sent':>11}{'shared':>9}  task"]
    for name, row in agents.items():
        sent = size_text(_number(row["bytes_sent"]))
        lines.append(
            f"{name:<10}{row['frames']:>8}{row['hz']:>8.1f}{row['gaussians']:>11}{row['roi_share']:>8.1%}"
            f"{sent:>11}{_number(row['map_shared_percent']):>8.1f}%  {row['task']}"
        )
    tasks = list(result.by_task)
    heads = "".join(f"{name + ' task':>15}" for name in tasks)
    lines += ["", f"{'PSNR (dB) in':<15}{heads}{'all regions':>13}{'whole image':>13}"]
    for name, score in result.scores.items():
        of_tasks = "".join(f"{_decibels(result.by_task[task][name].roi_psnr):>15}" for task in tasks)
        lines.append(f"{name:<15}{of_tasks}{_decibels(score.roi_psnr):>13}{_decibels(score.full_psnr):>13}")
    if fitted_views:
        lines.append("pose and exposure of each held-out view were fitted, because keyframes were refined")
    psnr = {
        f"the region of {task}": {name: maps[name].roi_psnr for name in maps} for task, maps in result.by_task.items()
    }
    psnr["whole images"] = {name: score.full_psnr for name, score in result.scores.items()}
    lines += ["", *(f"{name}: {purpose}" for name, purpose in MAP_PURPOSES.items() if name in result.scores)]
    lines += [sentence] if (sentence := team_sentence(psnr)) else []
    return "\n".join(lines) + "\n"


def _decibels(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """The options of `gausslite demo` beside those of perception and mapping."""

    out: Path = option(MISSING, "folder for report.html, report.json, maps and pictures", metavar="DIR")
    source: str | None = option(
        None, "a sequence to divide between the agents (default: a simulated home)", metavar="SOURCE", convert=not_empty
    )
    task_a: str = option("Pick up the mug on the table", "task of agent-a")
    task_b: str = option("Identify the chair closest to the table", "task of agent-b")
    frames: str | None = option(
        None,
        "frames of each agent (default: all of its path in the home; of a sequence, one half each)",
        metavar="START:STOP:STEP",
    )
    objects: tuple[str, ...] = option(
        (), "objects whose region of interest (ROI) is scored (default: the tasks' targets)", metavar="A,B"
    )
    size: str | None = option(None, f"image size (default: the recorded size; {HOME_SIZE} in the home)", metavar="WxH")
    voxel_size: VoxelGrid = option(VoxelGrid(), "edge of the fusion's voxels", **VOXEL_SIZE)
    refine_iterations: int = option(
        500, "joint refinement of the fused map; 0: none", low=0, high=MAX_REFINE_ITERATIONS
    )
    overwrite: bool = option(False, "replace the results of an earlier demo in --out")
    world_frame: str | None = option(
        None,
        "name of the poses' frame in all maps (default: the sequence folder's name or the simulated home)",
        metavar="NAME",
    )
    view: int | None = option(
        None,
        "show the fused map and each agent's on a page at http://127.0.0.1:PORT; 0 chooses a port (extra: view)",
        metavar="PORT",
        low=0,
        high=MAX_PORT,
    )


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite demo`."""
    Program.of(
        *(DemoOptions, RecordingOptions, PerceptionSettings, MissionSettings),
        flags="source task-a task-b objects size detector max-gaussians iterations seed out overwrite",
    ).add_to(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the services, score the maps, write and print the report. Returns the exit code."""
    signal.signal(signal.SIGHUP, signal.default_int_handler)
    pages = load_pages(REPORT_PAGE)
    _require_valid(options, pages)
    require_name("world-frame", options.world_frame or "")
    if not options.overwrite:
        require_no_demo(options.out)
    require_writable(options.out)
    scenario = simulated_scenario(options) if options.source is None else recorded_scenario(options)
    shared = _shared_agent_options(options, scenario)
    plan = DemoPlan(scenario.agents, shared, options.voxel_size.size_m, options.refine_iterations, options.seed)
    remove_results(options.out)
    with running_services(plan, options.out.absolute()) as services:
        with _page(options, pages, services.fusion_address):
            watch_missions(services)
        maps = collect_maps(services, options.out)
        agents = agent_reports(scenario.agents, options.out)
    corrupt = CorruptFrames(print_message)
    result = _score(options, scenario, maps, corrupt)
    report = demo_report(options, scenario, agents, result, corrupt.count)
    write_json(options.out / "report.json", report)
    _write_pictures(options.out / "pictures", result)
    print(report_tables(agents, result, scenario.fit_views))
    pages.write_report(options.out / REPORT_PAGE, [options.out])
    print(f"maps and pictures are in {options.out}; {options.out / REPORT_PAGE} shows them")
    return 0


@contextmanager
def _page(options: argparse.Namespace, pages: Pages, fusion_address: str) -> Iterator[None]:
    """Show the fusion server on a page, if view is set."""
    if options.view is None:
        yield
        return
    with pages.live_page(options.view, fusion_address, is_agent=False) as url:
        print_message(f"the page is at {url}")
        yield


def _require_valid(options: argparse.Namespace, pages: Pages) -> None:
    """Raise InvalidInputError or ModelFileError for options that every agent would refuse later."""
    if options.view is not None:
        pages.require_usable("--view")
    chosen_detector(build(PerceptionSettings, options).at_rate(mission_settings(options)))


def _shared_agent_options(options: argparse.Namespace, scenario: Scenario) -> dict[str, Plain]:
    """Return the options that all agents share; two agents share the processor, so each has one thread by default."""
    settings = mission_settings(options)
    threads = 1 if settings.threads is None else settings.threads
    settings = replace(settings, threads=threads, pose_prior=scenario.pose_prior)
    width, height = scenario.size
    registration, correction = scenario.depth_registration, scenario.camera_correction
    stated = options.world_frame
    return {
        "size": f"{width}x{height}",
        "voxel-size": options.voxel_size.size_m,
        "world-frame": default_world_frame(scenario.held_out[0].source) if stated is None else str(stated),
        "test-every": scenario.test_every,
        "register-depth": None if registration is None else str(registration),
        "camera-correction": None if correction.is_identity else str(correction),
        **plain_options(settings),
        **plain_options(build(PerceptionSettings, options).absolute()),
    }


def _score(
    options: argparse.Namespace, scenario: Scenario, maps: Mapping[str, Path], corrupt: CorruptFrames
) -> TeamScores:
    """Score the maps on the held-out frames that can be read."""
    regions = list(scenario.regions.values())
    frames = (frame for stream in scenario.held_out for frame in stream.frames(corrupt))
    views = [HeldOutView.of(frame, regions) for frame in frames if not frame.defect]
    if not views and corrupt.first_error is not None:
        raise corrupt.first_error
    rasterizer = choose_rasterizer(threads=options.threads)
    viewers = {name: MapViewer(read_ply(path, print_message), rasterizer) for name, path in maps.items()}
    return score_team(viewers, views, scenario.task_regions, scenario.fit_views)


def _write_pictures(folder: Path, scores: TeamScores) -> None:
    prepare_folder(folder)
    for name, sheet in scores.sheets.items():
        write_png(folder / f"{name}.png", sheet)
