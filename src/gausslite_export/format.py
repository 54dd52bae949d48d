"""What a plug-in of `gausslite.exporters` writes and how: the type of the formats of `gausslite export`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.render.map_viewer import MapViewer, view_map

MAX_EXTENT_M = 1e5
"""Limit of the coordinates that the mapper's voxel grid of 0.1 m can hold; a file with larger ones is damaged."""


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """A map and the other content of its results folder; `views` and `report` are empty for a single PLY file.

    gaussians: the whole map. chosen: the Gaussians to write, at least one. left_out: how many Gaussians of the file are
    in neither; notes: why, because they are no numbers, too far away or too large. harmonics: of the chosen ones, for
    each channel the coefficients above degree 0 of colours that depend on the view; None if all have one colour.
    """

    gaussians: Gaussians
    chosen: Gaussians
    left_out: int = 0
    notes: tuple[str, ...] = ()
    world_frame: str = ""
    views: Sequence[KeyframeView] = ()
    depths_m: Mapping[int, Float32[ndarray, "h w"]] = field(default_factory=dict)
    T_upright_map: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    report: Mapping[str, object] = field(default_factory=dict)
    harmonics: Float32[ndarray, "n 3 k"] | None = None


@dataclass(frozen=True, slots=True)
class ExportSettings:
    """What a format may use. viewer: returns what renders a map. progress: wraps the views that are rendered.

    voxel_m, min_opacity, seconds, spz_version: what the user sets, only for a format whose `uses` has the option's
    name; None means the format's own value.
    """

    viewer: Callable[[Gaussians], MapViewer] = view_map
    progress: Callable[[Iterable[KeyframeView]], Iterable[KeyframeView]] = iter
    voxel_m: float | None = None
    min_opacity: float | None = None
    seconds: float | None = None
    spz_version: int | None = None


@dataclass(frozen=True, slots=True)
class Format:
    """A file format, registered under its name.

    suffix: of the written file. summary: a few words for the help. write: writes `chosen` of the content; raises
    InvalidInputError, StorageError. region_only: without a choice of the user, write only the task's region.
    max_extent_m: the largest coordinate and standard deviation that the format holds. companion: suffix of a second
    file with the same name. is_upright: its z axis points up. keeps_harmonics: it holds colours that depend on the
    view. uses: names of the options that have an effect, of
    "voxel", "min_opacity", "seconds" and "spz_version".
    """

    suffix: str
    summary: str
    write: Callable[[Path, MapContent, ExportSettings], None]
    region_only: bool = False
    max_extent_m: float = MAX_EXTENT_M
    companion: str = ""
    is_upright: bool = False
    keeps_harmonics: bool = False
    uses: tuple[str, ...] = ()

    def files(self, out: Path) -> tuple[Path, ...]:
        """Return the files written for this path. Raises InvalidInputError for the suffix of another format."""
        suffixes = (".yaml", ".yml") if self.suffix == ".yaml" else (Path(f"x{self.suffix}").suffix,)
        if out.suffix.lower() not in suffixes:
            expected = " or ".join(suffixes)
            raise InvalidInputError(
                f"--out {out}: expected a name with the suffix {expected}, such as map{self.suffix}"
            )
        return (out, out.with_suffix(self.companion)) if self.companion else (out,)
