"""`gausslite demo`: two agents map one place for two tasks; the fused map is scored against each agent's own."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType

from gausslite.cli.demo.report import agent_reports, demo_report, report_tables
from gausslite.cli.demo.results_folder import remove_results, require_no_demo
from gausslite.cli.demo.scenario import HOME_SIZE, Scenario, recorded_scenario, simulated_scenario
from gausslite.cli.demo.services import DemoPlan, collect_maps, running_services, watch_missions
from gausslite.codec.ply import read_ply
from gausslite.codec.png import write_png
from gausslite.config.mapping_options import (
    add_budget,
    add_detector,
    add_policy,
    add_voxel_size,
    mission_options,
    mission_settings,
    perception_options,
    perception_settings,
)
from gausslite.config.options_without_effect import require_effect
from gausslite.config.source_options import add_camera_correction, add_register_depth
from gausslite.config.switches import add_switch
from gausslite.config.toml_text import OptionValue
from gausslite.config.values import AUTO, read_names
from gausslite.config.view_option import add_view
from gausslite.datasets.sequence_name import default_world_frame
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import require_name
from gausslite.domain.voxels import VoxelGrid
from gausslite.evaluation.team import TeamScores, score_team
from gausslite.evaluation.views import HeldOutView, view_maps
from gausslite.export.packages import import_extra
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.mission.build import open_models
from gausslite.mission.frame_stream import CorruptFrames
from gausslite.mission.results import prepare_folder, require_writable, write_json
from gausslite.process.messages import print_message
from gausslite.process.siblings import Sibling, sibling


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite demo`."""
    add = parser.add_argument
    add("--source", metavar="SOURCE", help="a sequence to divide between the agents (default: a simulated home)")
    add("--task-a", metavar="TEXT", default="Pick up the mug on the table", help="task of agent-a")
    add("--task-b", metavar="TEXT", default="Identify the chair closest to the table", help="task of agent-b")
    add("--frames-a", metavar="START:STOP:STEP", help="frames of agent-a (default: the first half)")
    add("--frames-b", metavar="START:STOP:STEP", help="frames of agent-b (default: the second half)")
    add(
        "--objects",
        metavar="A,B",
        type=read_names,
        default=(),
        help="objects whose region of interest (ROI) is scored (default: the tasks' targets)",
    )
    add("--size", metavar="WxH", help=f"image size (default: the recorded size; {HOME_SIZE} in the home)")
    add_register_depth(parser, allow_auto=True, default_text=AUTO)
    add_camera_correction(parser, allow_auto=True, default_text=AUTO)
    add_voxel_size(parser)
    add("--refine-iterations", metavar="N", type=int, default=500, help="joint refinement of the fused map; 0: none")
    add_detector(parser)
    add_policy(parser, allow_auto=True)
    add_budget(parser)
    add("--out", metavar="DIR", type=Path, required=True, help="folder for report.html, report.json, maps and pictures")
    add_switch(parser, "--overwrite", "replace the results of an earlier demo in --out")
    add(
        "--world-frame",
        metavar="NAME",
        help="name of the poses' frame in all maps (default: the sequence folder's name or the simulated home)",
    )
    add_view(parser, "the fused map and each agent's")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the services, score the maps, write and print the report. Returns the exit code."""
    signal.signal(signal.SIGHUP, _raise_interrupt)
    _require_valid(options)
    require_name("--world-frame", options.world_frame or "")
    if not options.overwrite:
        require_no_demo(options.out)
    require_writable(options.out)
    scenario = simulated_scenario(options) if options.source is None else recorded_scenario(options)
    plan = DemoPlan(
        scenario.agents,
        _shared_agent_options(options, scenario),
        options.voxel_size,
        options.refine_iterations,
        options.seed,
    )
    remove_results(options.out)
    with running_services(plan, options.out.absolute()) as services:
        with _page(options, services.fusion_address):
            watch_missions(services)
        maps = collect_maps(services, options.out)
        agents = agent_reports(scenario.agents, options.out)
    corrupt = CorruptFrames(print_message)
    result = _score(options, scenario, maps, corrupt)
    report = demo_report(options, scenario, agents, result.scores, corrupt.count)
    write_json(options.out / "report.json", report)
    _write_pictures(options.out / "pictures", result)
    print(report_tables(agents, result.scores, scenario.fit_views))
    sibling(Sibling.REPORT).write_report(options.out / REPORT_PAGE, [options.out])
    print(f"maps and pictures are in {options.out}; {options.out / REPORT_PAGE} shows them")
    return 0


@contextmanager
def _page(options: argparse.Namespace, fusion_address: str) -> Iterator[None]:
    """Show the fusion server on a page, if --view is set."""
    if options.view is None:
        yield
        return
    with sibling(Sibling.LIVE_PAGE).live_page(options.view, fusion_address, is_agent=False) as url:
        print_message(f"the page is at {url}")
        yield


def _require_valid(options: argparse.Namespace) -> None:
    """Raise InvalidInputError or ModelFileError for options that every agent would refuse later."""
    if not 0 <= options.refine_iterations <= MAX_REFINE_ITERATIONS:
        raise InvalidInputError(
            f"--refine-iterations: expected 0 to {MAX_REFINE_ITERATIONS}, got {options.refine_iterations}"
        )
    if options.view is not None:
        import_extra("viser", "view", "--view")
    require_effect(options)
    mission_settings(options)
    VoxelGrid(options.voxel_size)
    open_models(perception_settings(options))


def _shared_agent_options(options: argparse.Namespace, scenario: Scenario) -> dict[str, OptionValue]:
    """Return the options that all agents share; two agents share the processor, so each has one thread by default."""
    settings = mission_settings(options)
    threads = 1 if settings.threads is None else settings.threads
    settings = replace(settings, threads=threads, pose_prior=scenario.pose_prior)
    width, height = scenario.size
    registration, correction = scenario.depth_registration, scenario.camera_correction
    return {
        "size": f"{width}x{height}",
        "voxel-size": options.voxel_size,
        "world-frame": _world_frame(options, scenario),
        "test-every": scenario.test_every,
        "register-depth": None if registration is None else str(registration),
        "camera-correction": None if correction.is_identity else str(correction),
        **mission_options(settings),
        **perception_options(perception_settings(options)),
    }


def _world_frame(options: argparse.Namespace, scenario: Scenario) -> str:
    if options.world_frame is not None:
        return str(options.world_frame)
    return default_world_frame(scenario.held_out[0].source)


def _score(
    options: argparse.Namespace, scenario: Scenario, maps: Mapping[str, Path], corrupt: CorruptFrames
) -> TeamScores:
    """Score the maps on the held-out frames that can be read."""
    regions = list(scenario.regions.values())
    frames = (frame for stream in scenario.held_out for frame in stream.frames(corrupt))
    views = [HeldOutView.of(frame, regions) for frame in frames if frame.has_depth]
    if not views and corrupt.first_error is not None:
        raise corrupt.first_error
    viewers = view_maps({name: read_ply(path) for name, path in maps.items()}, options.threads)
    return score_team(viewers, views, scenario.fit_views)


def _write_pictures(folder: Path, scores: TeamScores) -> None:
    prepare_folder(folder)
    for name, sheet in scores.sheets.items():
        write_png(folder / f"{name}.png", sheet)


def _raise_interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
