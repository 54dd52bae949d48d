"""`gausslite bench registration`: map quality with a given registration of depth to colour."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import option
from gausslite.config.program import Program
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.source import HeldOutSplit, frame_size, select_frames
from gausslite.domain.recording import DepthRegistration
from gausslite.evaluation.compare import MapScores, average, score_view
from gausslite.evaluation.views import HeldOutView, MapViewer
from gausslite.mapping.policies import follows_task
from gausslite.mission.build import build_mapper
from gausslite.mission.runner import FrameStream, MissionRunner
from gausslite.mission.settings import MissionSettings, SourceSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator, RegionRelevanceEstimator
from gausslite.render.choose import choose_rasterizer


@dataclass(frozen=True, slots=True)
class RegistrationOptions:
    """The options of `bench registration` beside those of the source and the map."""

    objects: tuple[str, ...] = option((), "objects of the task's region (default: all)", metavar="A,B")
    masks: DepthRegistration | None = option(
        None,
        "registration for the region's masks, as in register-depth; use one value to compare several runs on the same "
        "pixels (default: that of register-depth)",
        metavar="REGISTRATION",
        plain_type=str,
        convert=DepthRegistration.parse,
    )


def configure_registration(parser: CommandParser) -> None:
    """Add the options of `bench registration`."""
    Program.of(
        *(RegistrationOptions, SourceSettings, MissionSettings),
        flags="objects policy frames size max-gaussians iterations seed register-depth masks",
        positional="source",
        omit=("test-every", "camera-correction", "pose-prior", "poses", "track-motion", "rate"),
    ).add_to(parser)
    parser.set_defaults(run=run_registration)


def run_registration(options: argparse.Namespace) -> int:
    """Map the training frames, score the held-out frames and print one line."""
    print(registration_line(options, *map_and_score(options)))
    return 0


def map_and_score(options: argparse.Namespace) -> tuple[MapScores, int]:
    """Return the scores on the held-out frames and the number of Gaussians. Raises GaussLiteError."""
    source = open_source(options.source, options.up, options.register_depth)
    mask_source = open_source(options.source, options.up, options.masks or options.register_depth)
    size, regions = frame_size(options.size, source), choose_regions(source.regions(), options.objects)
    training, held_out = HeldOutSplit().split(select_frames(source, options.frames))
    settings = MissionSettings(
        options.policy,
        max_gaussians=options.max_gaussians,
        iterations=options.iterations,
        seed=options.seed,
        threads=options.threads,
    )
    estimator = RegionRelevanceEstimator(regions) if follows_task(options.policy) else NoTaskEstimator()
    mapper = TaskMapper(estimator, build_mapper(settings))
    MissionRunner(mapper.process).run(FrameStream(source, training, size).frames()).raise_if_stopped()
    gaussians = mapper.gaussians()
    viewer = MapViewer(gaussians, choose_rasterizer(threads=options.threads))
    scores = []
    for position in held_out:
        roi = HeldOutView.of(mask_source.frame(position, size), regions).roi
        view = HeldOutView(source.frame(position, size), roi)
        scores.append(score_view(viewer.render_frame(view.frame), view))
    return average(scores), len(gaussians)


def registration_line(options: argparse.Namespace, scores: MapScores, gaussians: int) -> str:
    """Return settings, ROI and full-image PSNR with SSIM, and the number of Gaussians."""
    roi = "none" if scores.roi_psnr is None else f"{scores.roi_psnr:.2f} dB ({scores.roi_ssim:.3f})"
    return (
        f"{options.policy} {','.join(options.objects)} seed {options.seed} registration {options.register_depth}: "
        f"ROI {roi}, full {scores.full_psnr:.2f} dB ({scores.full_ssim:.3f}), {gaussians} Gaussians"
    )
