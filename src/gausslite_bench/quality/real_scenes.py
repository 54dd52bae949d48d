"""Scenes of recorded sequences."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gausslite.datasets.camera_files import CAMERA_FILE, INTRINSICS_FILE, find_in_or_above
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import balls_for_small_objects, choose_regions, load_voxel_regions
from gausslite.datasets.source import HeldOutSplit, Source
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import UpAxis
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import MIN_ROI_PIXELS
from gausslite.mission.settings import SceneInfo
from gausslite.nouns import head_of
from gausslite_bench.quality.scenes import Scene, UnseenRegionError, make_scene
from gausslite_calibration.corrected import CorrectedSource
from gausslite_evaluation.views import HeldOutView

REAL_CAMERA = PoseExposurePrior(translation_m=0.01, rotation_deg=0.5, gain=0.1, offset=0.03)
"""A handheld camera with automatic exposure, tracked to about a centimetre."""
_NUMBERED = re.compile(r"seq-?\d+")
"""Folder names that need the parent's name to be distinctive."""


@dataclass(frozen=True, slots=True)
class RealScenePlan:
    """A recorded sequence and its objects of one kind; every eighth frame is held out.

    frames: approximate number of training frames, spread over the sequence; None uses all.
    """

    folder: Path
    roi: Path
    kind: str
    objects: tuple[str, ...]
    frames: int | None = None
    up_axis: UpAxis | None = None
    depth_registration: DepthRegistration | None = None
    camera_correction: CameraCorrection | None = None
    pose_prior: PoseExposurePrior = REAL_CAMERA
    split: HeldOutSplit = field(default_factory=HeldOutSplit)

    def __post_init__(self) -> None:
        if not self.kind or "/" in self.kind:
            raise InvalidInputError(f"{self.roi}: expected objects that can name files, got {', '.join(self.objects)}")

    @property
    def name(self) -> str:
        """Such as redkitchen-chair."""
        folder = self.folder.resolve()
        place = f"{folder.parent.name}-{folder.name}" if _NUMBERED.fullmatch(folder.name) else folder.name
        return f"{place}-{self.kind}"

    @property
    def task(self) -> str:
        """A search for the kind."""
        return f"Find the {self.kind}"

    def settings(self) -> Mapping[str, object]:
        """Return the training settings, the objects and the digest of the region file."""
        regions = hashlib.sha256(self.roi.read_bytes()).hexdigest()
        return {**self.training_settings(), "objects": list(self.objects), "regions": regions}

    def training_settings(self) -> Mapping[str, object]:
        """Return the folder, the frame selection, and the digests of the camera files."""
        cameras = [find_in_or_above(self.folder, name) for name in (CAMERA_FILE, INTRINSICS_FILE)]
        files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in cameras if path is not None}
        return {
            "folder": str(self.folder.resolve()),
            "frames": self.frames,
            "up": self.up_axis,
            "test_every": self.split.every,
            "depth_registration": str(self.depth_registration),
            "camera_correction": str(self.camera_correction),
            **files,
        }

    def load(self, size: tuple[int, int], is_part_of_team: bool = False) -> Scene:
        """Return the scene. Raises UnseenRegionError unless part of a team, DatasetError, InvalidInputError."""
        source = open_source(str(self.folder), self.up_axis, self.depth_registration)
        if self.camera_correction is not None:
            source = CorrectedSource(source, self.camera_correction)
        all_regions = balls_for_small_objects(load_voxel_regions(self.roi))
        regions = choose_regions(all_regions, self.objects)
        training, held_out = self.split.split(self._positions(source))
        views = [HeldOutView.of(source.frame(i, size), regions) for i in held_out]
        views = [view for view in views if not view.frame.defect]
        if views and not is_part_of_team:
            self.require_shown(views)
        info = SceneInfo(source.up_axis, all_regions)
        return make_scene(self.task, [source.frame(i, size) for i in training], views, regions, info)

    def require_shown(self, views: Sequence[HeldOutView]) -> None:
        """Raise UnseenRegionError unless one of the held-out views shows the objects."""
        if not any(view.shows_region for view in views):
            camera = views[0].frame.camera
            raise UnseenRegionError(
                f"{self.name}: expected held-out views that show at least {MIN_ROI_PIXELS} pixels of "
                f"{', '.join(self.objects)} at {camera.width_px}x{camera.height_px}, got none of {len(views)}"
            )

    def _positions(self, source: Source) -> list[int]:
        if self.frames is None:
            return list(range(len(source)))
        count = min(len(source), round(self.frames * self.split.every / (self.split.every - 1)))
        return sorted({round(i) for i in np.linspace(0, len(source) - 1, count)})


def real_plans(
    folder: Path,
    roi: Path,
    frames: int | None = None,
    up_axis: UpAxis | None = None,
    chosen: Sequence[str] = (),
) -> list[RealScenePlan]:
    """Return one plan per kind of object in the region file: mug_1 and mug_2 are of kind mug.

    chosen: kinds to return; all if empty. Raises DatasetError, InvalidInputError for an unknown kind.
    """
    kinds: dict[str, list[str]] = {}
    for name in load_voxel_regions(roi):
        kinds.setdefault(head_of(name), []).append(name)
    unknown = [kind for kind in chosen if kind not in kinds]
    if unknown:
        raise InvalidInputError(f"kinds: expected names among {', '.join(kinds)}, got {', '.join(unknown)}")
    return [
        RealScenePlan(folder, roi, kind, tuple(objects), frames, up_axis)
        for kind, objects in kinds.items()
        if not chosen or kind in chosen
    ]
