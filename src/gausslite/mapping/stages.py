"""The stages of a frame, and the protocol of what divides its time among them."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from enum import StrEnum
from typing import Protocol, runtime_checkable


class Stage(StrEnum):
    """One measured part of processing a frame, in the order of the loop."""

    TRACKING = "tracking"
    """Find the camera's pose by aligning the frame to the map."""
    RENDERING = "rendering"
    """Render the map from the frame's pose."""
    RELEVANCE = "relevance"
    """Detect, track and decide which pixels are relevant to the task."""
    REEVALUATION = "reevaluation"
    """Evaluate earlier keyframes for a new task."""
    KEYFRAME_REFINEMENT = "keyframe_refinement"
    """Refine the pose and exposure of an earlier keyframe."""
    VIEW_PREPARATION = "view_preparation"
    """Refine the frame's pose and exposure and prepare the frame for training."""
    SEEDING = "seeding"
    WARM_UP = "warm_up"
    """Iterations over full images."""
    ACTIVE = "active"
    """Iterations over the task's region."""
    PRUNING = "pruning"
    DENSIFICATION = "densification"
    FINALISATION = "finalisation"
    """Clamp colours and update the EMA after the iterations."""
    LOOP_CLOSURE = "loop_closure"
    """Find a loop of a keyframe, and correct poses and map."""
    PUBLISHING = "publishing"
    """Find the changed voxels of the region and pass them to the uplink."""


class SkippableStage(StrEnum):
    """A part of processing that a frame may skip if its time is short."""

    PUBLISHING = "publishing"
    """The next frame publishes the changes of this one too, because updates state totals."""
    SEEDING = "seeding"
    """The frame neither renders the map first nor adds Gaussians; it only trains."""


ITERATION_STAGES = frozenset((Stage.WARM_UP, Stage.ACTIVE))


@runtime_checkable
class StageScheduler(Protocol):
    """Decides which stages of a frame run and for how many iterations."""

    def timing(self, stage: Stage) -> AbstractContextManager[None]:
        """Return a context that surrounds one execution of the stage."""

    def skips(self, stage: SkippableStage) -> bool:
        """Return True if the current frame skips this stage."""

    def has_time_for(self, stage: Stage) -> bool:
        """Return True if the frame is expected to meet its deadline with this optional stage."""

    def trains_on(self, stage: Stage, iterations_per_frame: int) -> bool:
        """Return True if another iteration of this stage should run."""


class CountedScheduler:
    """A StageScheduler for one frame without a deadline: nothing is skipped and iterations are counted."""

    def __init__(self) -> None:
        self._iterations = 0

    def timing(self, stage: Stage) -> AbstractContextManager[None]:
        """Count the stage if it is an iteration."""
        self._iterations += stage in ITERATION_STAGES
        return nullcontext()

    def skips(self, stage: SkippableStage) -> bool:
        """Return False."""
        del stage
        return False

    def has_time_for(self, stage: Stage) -> bool:
        """Return True."""
        del stage
        return True

    def trains_on(self, stage: Stage, iterations_per_frame: int) -> bool:
        """Return True until the number of iterations is reached."""
        del stage
        return self._iterations < iterations_per_frame
