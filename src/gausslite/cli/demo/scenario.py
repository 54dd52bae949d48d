"""Choose the sequences, tasks and held-out views of the demo: a simulated home or a recorded sequence."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field

from gausslite.cli.source_options import (
    calibrate_with_messages,
    open_recorded,
    report_region_file,
    stated_values,
)
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.domain.region import Region
from gausslite.mission.frame_stream import FrameStream
from gausslite.mission.settings import SceneInfo

HOME_SIZE = "320x240"
_HOME = "sim:home?seed={seed}&trajectory={trajectory}&frames={frames}"
_HOME_FRAMES, _HOME_VIEWS = 120, 24
_TEST_EVERY = 8


@dataclass(frozen=True, slots=True)
class AgentPlan:
    """The mission of one agent, and how many frames it maps."""

    agent_id: str
    task: str
    source: str
    frames: str
    frame_count: int


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """Sequences and tasks of the agents, and the views and regions on which their maps are scored.

    test_every: agents keep every n-th frame from mapping; None if the held-out views are of another sequence.
    """

    agents: tuple[AgentPlan, ...]
    size: tuple[int, int]
    test_every: int | None
    held_out: tuple[FrameStream, ...]
    regions: Mapping[str, Region]
    depth_registration: DepthRegistration | None = None
    camera_correction: CameraCorrection = field(default_factory=CameraCorrection)
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)

    @property
    def fit_views(self) -> bool:
        """True if views are fitted before scoring: refined keyframes shift the map against the recorded poses."""
        return not self.pose_prior.is_exact


def simulated_scenario(options: argparse.Namespace) -> Scenario:
    """Return two trajectories through one home; the held-out views are of a third one. Raises InvalidInputError."""
    if options.register_depth is not None:
        raise InvalidInputError("register-depth: expected a recorded sequence, --source SOURCE; got none")
    if options.camera_correction is not None:
        raise InvalidInputError("camera-correction: expected a recorded sequence, --source SOURCE; got none")
    specs = [
        _HOME.format(seed=options.seed, trajectory=number, frames=_HOME_VIEWS if number == 2 else _HOME_FRAMES)
        for number in range(3)
    ]
    missions = [(specs[0], options.task_a, options.frames_a), (specs[1], options.task_b, options.frames_b)]
    agents = tuple(
        AgentPlan(f"agent-{letter}", task, spec, frames or ":", len(select_frames(open_source(spec), frames or ":")))
        for letter, (spec, task, frames) in zip("ab", missions, strict=True)
    )
    held_out = open_source(specs[2])
    size = frame_size(options.size or HOME_SIZE, held_out)
    found = calibrate_with_messages(specs[2], held_out, stated_values(None, None, options.pose_prior))
    return Scenario(
        agents,
        size,
        None,
        (FrameStream(held_out, range(len(held_out)), size),),
        _scored_regions(options, held_out.regions()),
        pose_prior=found.pose_prior,
    )


def recorded_scenario(options: argparse.Namespace) -> Scenario:
    """Return the two halves of one sequence; every eighth frame of each is held out.

    Raises DatasetError, InvalidInputError.
    """
    recorded = open_recorded(options.source, None)
    middle = recorded.indices()[len(recorded) // 2]
    first, second = options.frames_a or f":{middle}", options.frames_b or f"{middle}:"
    size, regions = frame_size(options.size, recorded), _scored_regions(options, recorded.regions())
    report_region_file(options.source, recorded)
    agents, held_out_positions = [], []
    for letter, task, frames in (("a", options.task_a, first), ("b", options.task_b, second)):
        training, held_out = HeldOutSplit(_TEST_EVERY).split(select_frames(recorded, frames))
        agents.append(AgentPlan(f"agent-{letter}", task, str(options.source), frames, len(training)))
        held_out_positions.append(held_out)
    stated = stated_values(options.register_depth, options.camera_correction, options.pose_prior)
    found = calibrate_with_messages(options.source, recorded, stated)
    views = tuple(FrameStream(found.source, positions, size) for positions in held_out_positions)
    return Scenario(
        agents=tuple(agents),
        size=size,
        test_every=_TEST_EVERY,
        held_out=views,
        regions=regions,
        depth_registration=found.registration,
        camera_correction=found.correction,
        pose_prior=found.pose_prior,
    )


def _scored_regions(options: argparse.Namespace, regions: Mapping[str, Region]) -> dict[str, Region]:
    """Return the objects of --objects or, without them, the targets of the tasks. Raises InvalidInputError."""
    if options.objects:
        return dict(zip(options.objects, choose_regions(regions, options.objects), strict=True))
    from gausslite.task.rules import RuleParser

    targets = {t for task in (options.task_a, options.task_b) for t in RuleParser().parse(task).targets}
    chosen = SceneInfo(regions=regions).regions_of(targets)
    if not chosen:
        raise InvalidInputError(
            f"demo: expected ground-truth regions of {', '.join(sorted(targets))} to score, "
            f"got {', '.join(regions) or 'none'}"
        )
    return chosen
