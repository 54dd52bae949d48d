"""A run that continues a saved map: localise its frames there, say what changed, and keep this for a resumed run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import require_rigid
from gausslite.domain.state import State, encode_text, get_array, get_counts, get_text, int_array
from gausslite.mapping.free_space import DepthView
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.settings import MissionSettings
from gausslite_evaluation.views import view_map
from gausslite_places.map_diff import Change, Visit, compare_visits, with_earlier_objects
from gausslite_places.prior_map import SavedMap, SequenceLocaliser


def require_other_folder(prior: Path | None, out: Path) -> None:
    """Raise InvalidInputError for a saved map in the folder of the new run, which would replace it."""
    if prior is not None and prior.resolve() == out.resolve():
        raise InvalidInputError(f"--prior {prior}: expected another folder than --out, whose map is replaced")


class PriorRun:
    """A saved map and the place of a sequence in it. Not thread-safe."""

    def __init__(self, saved: SavedMap, settings: MissionSettings) -> None:
        """settings: those of the new run. Renders the keyframes of the saved map."""
        start_s = time.monotonic()
        self.saved = saved
        self._viewer = view_map(saved.gaussians, settings.backend, settings.threads)
        self._localiser = SequenceLocaliser(saved.places(self._viewer))
        self._seconds = time.monotonic() - start_s

    @property
    def motion(self) -> Float64[ndarray, "4 4"] | None:
        """T_map_sequence, which moves the sequence into the saved map's frame; None if it is not recognised there."""
        return self._localiser.T_map_sequence

    @property
    def is_done(self) -> bool:
        """True if the sequence is localised, or enough frames were tried."""
        return self._localiser.is_done

    def offer(self, frame: Frame) -> None:
        """Localise a frame, whose pose is in the sequence's frame."""
        start_s = time.monotonic()
        self._localiser.offer(frame)
        self._seconds += time.monotonic() - start_s

    def describe(self) -> str:
        """Return one line: whether the sequence is localised."""
        tried = f"{self._localiser.tried} frame{'' if self._localiser.tried == 1 else 's'}"
        if self.motion is not None:
            return f"prior {self.saved.folder}: localised after {tried} in {self._seconds:.1f} s"
        return (
            f"prior {self.saved.folder}: its map does not show the place of {tried} that were tried; "
            "this run begins a map of its own"
        )

    def gaussians_for(self, task: str) -> Gaussians | None:
        """Return the Gaussians that a run of this task continues with; None if the sequence is not recognised."""
        return None if self.motion is None else self.saved.gaussians_for(task)

    def changes(
        self, gaussians: Gaussians, objects: Sequence[ObjectLandmark], keyframes: Sequence[Keyframe]
    ) -> list[Change]:
        """Return what the run's map, objects and keyframes show to have changed since the saved map."""
        if self.motion is None:
            return []
        before = Visit(self.saved.gaussians, self.saved.objects, self.saved.depth_views(self._viewer))
        views = [DepthView.of_frame(keyframe.frame) for keyframe in keyframes]
        return compare_visits(before, Visit(gaussians, objects, views))

    def objects(self, found: Sequence[ObjectLandmark], changes: Sequence[Change]) -> list[ObjectLandmark]:
        """Return the run's objects, and the earlier ones that it has neither found again nor seen to be gone."""
        earlier = () if self.motion is None else self.saved.objects
        return with_earlier_objects(found, earlier, changes)

    def report(self, changes: Sequence[Change]) -> dict[str, object]:
        """Return the prior and what changed as parts of report.json."""
        motion = self.motion
        return {
            "prior": {
                "run": str(self.saved.folder),
                "localised": motion is not None,
                "T_map_sequence": None if motion is None else motion.tolist(),
                "frames_tried": self._localiser.tried,
                "seconds": self._seconds,
            },
            "changes": [change.as_json() for change in changes],
        }

    def state(self) -> State:
        """Return what a resumed run needs."""
        motion = self.motion
        return {
            "prior_folder": encode_text(str(self.saved.folder)),
            "prior_T_map_sequence": np.zeros((0, 4, 4)) if motion is None else motion[None],
            "prior_tried": int_array(self._localiser.tried),
        }

    @classmethod
    def resumed(cls, extra: State, settings: MissionSettings) -> PriorRun | None:
        """Return the prior of a saved run; None without one. Raises MapFileError."""
        if "prior_folder" not in extra:
            return None
        prior = cls(SavedMap.read(Path(get_text(extra, "prior_folder"))), settings)
        for T in get_array(extra, "prior_T_map_sequence", (None, 4, 4), np.float64):
            require_rigid("state prior motion", T)
            prior._localiser.T_map_sequence = T.copy()
        [prior._localiser.tried] = get_counts(extra, "prior_tried", 1)
        return prior
