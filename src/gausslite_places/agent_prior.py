"""Localise an agent's first frames in a saved map, then move every frame to the map's frame."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import PoseCorrection, inverse, orthonormal
from gausslite.domain.relevance import Region
from gausslite.domain.state import State
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.settings import MissionSettings
from gausslite_places.prior_run import PriorRun

_log = logging.getLogger(__name__)
LOCALISING = "the agent localises itself in the map of --prior"


class PriorFrames:
    """Moves frames to the frame of a saved map. The worker thread uses it; without a prior it changes nothing."""

    def __init__(self, prior: PriorRun | None) -> None:
        self.run = prior

    def in_map(self, frame: Frame, mapper: GaussianMapper, task: str) -> Frame | None:
        """Return the frame with its pose in the map's frame; None while the agent localises itself.

        The frame that localises it adds the saved map to the mapper. Raises QuotaError if that does not fit.
        """
        prior = self.run
        if prior is None:
            return frame
        if not prior.is_done:
            prior.offer(frame)
            if not prior.is_done:
                return None
            _log.warning("%s", prior.describe())
            earlier = prior.gaussians_for(task)
            if earlier is not None:
                mapper.continue_map(earlier)
        motion = prior.motion
        return frame if motion is None else replace(frame, T_world_camera=orthonormal(motion @ frame.T_world_camera))

    def correction(self, latest: PoseCorrection | None) -> PoseCorrection | None:
        """Return the correction of the odometry's own poses, from that of the moved ones."""
        motion = None if self.run is None else self.run.motion
        if latest is None or motion is None:
            return latest
        return replace(latest, T_map_odometry=latest.T_map_odometry @ motion)

    def regions(self, regions: Mapping[str, Region]) -> Mapping[str, Region]:
        """Return ground-truth regions of a sequence for its moved frames."""
        return (
            regions if self.run is None else {name: _SequenceRegion(region, self) for name, region in regions.items()}
        )

    def state(self) -> State:
        """Return what a restarted agent needs."""
        return {} if self.run is None else self.run.state()

    def restore(self, saved: State, settings: MissionSettings) -> None:
        """Continue from the state of a saved mission, with its prior. Raises MapFileError."""
        self.run = PriorRun.resumed(saved, settings)


@dataclass(frozen=True, slots=True, eq=False)
class _SequenceRegion:
    """A region in the sequence's own frame; the motion is known later than the region."""

    region: Region
    frames: PriorFrames

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the frame shows the region."""
        motion = None if self.frames.run is None else self.frames.run.motion
        if motion is not None:
            frame = replace(frame, T_world_camera=orthonormal(inverse(motion) @ frame.T_world_camera))
        return self.region.mask(frame)
