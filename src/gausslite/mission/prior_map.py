"""Continue the map of an earlier run, in its world frame: a plug-in of `gausslite.localisers` finds the run's place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.source import Source
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.state import State, get_text
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.runner import FrameStream
from gausslite.mission.settings import MissionSettings
from gausslite.plugins import Group, load

PRIOR_FOLDER: Final = "prior_folder"
"""Name of the earlier run's folder among the extra arrays of a saved run."""


@dataclass(frozen=True, slots=True)
class MapChanges:
    """What changed since the earlier map.

    objects: of the run, and earlier ones that it has neither found again nor seen to be gone.
    """

    objects: Sequence[ObjectLandmark]
    lines: tuple[str, ...] = ()  # the changes, for a person
    report: Mapping[str, object] = field(default_factory=dict)  # parts of report.json


@runtime_checkable
class PriorMap(Protocol):
    """The map of an earlier run, and the place of a new run in it. Not thread-safe."""

    @property
    def motion(self) -> Float64[ndarray, "4 4"] | None:
        """T_map_sequence, which moves the new run's poses into the map's frame; None if it is not recognised there."""

    @property
    def world_frame(self) -> str:
        """The name of the map's frame; empty if the new run is not recognised there."""

    @property
    def is_done(self) -> bool:
        """True if the new run is localised, or enough frames were tried."""

    def localise(self, stream: FrameStream, spread: bool) -> None:
        """Localise frames of a recording: spread over it, or its first ones."""

    def place(self, frame: Frame) -> Frame | None:
        """Localise a live frame and return it in the map's frame, or as it is if that fails; None until it is done."""

    def describe(self) -> str:
        """Return one line: whether the new run is localised."""

    def gaussians_for(self, task: str) -> Gaussians | None:
        """Return the Gaussians that a run of this task continues with; None if it is not recognised."""

    def moved(self, source: Source) -> Source:
        """Return a sequence of the new run with poses and regions in the map's frame, once it is recognised."""

    def compare(
        self, gaussians: Gaussians, objects: Sequence[ObjectLandmark], keyframes: Sequence[Keyframe]
    ) -> MapChanges:
        """Return what the new run's map, objects and keyframes show to have changed."""

    def state(self) -> State:
        """Return what a resumed run needs; PRIOR_FOLDER is the text of the folder."""


OpenPriorMap = Callable[[Path, MissionSettings, State], PriorMap]
"""The plug-in: reads the folder of an earlier run, for a new run, or for one with this state. Raises MapFileError."""


def open_prior_map(folder: Path | None, saved: State, settings: MissionSettings) -> PriorMap | None:
    """Return the map of the run in a folder, or of the extra arrays of a saved run; None if a run begins its own.

    Raises MapFileError, MissingPluginError.
    """
    folder = Path(get_text(saved, PRIOR_FOLDER)) if PRIOR_FOLDER in saved else folder
    if folder is None:
        return None
    open_plugin: OpenPriorMap = load(Group.LOCALISERS, purpose=f"--prior {folder}")
    return open_plugin(folder, settings, saved)


def compare_with_prior(
    prior: PriorMap | None,
    gaussians: Callable[[], Gaussians],
    objects: Sequence[ObjectLandmark],
    keyframes: Sequence[Keyframe],
) -> MapChanges:
    """Return what changed since the earlier map; without one, the run's own objects."""
    return MapChanges(objects) if prior is None else prior.compare(gaussians(), objects, keyframes)
