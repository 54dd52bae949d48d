"""Score a team's maps side by side on the same held-out views: each agent alone, and every way of fusing them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float32, UInt8
from numpy import ndarray

from gausslite.datasets.source import Source
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.region import Region
from gausslite.errors import InvalidInputError
from gausslite.evaluation.compare import MapScores, ViewScore, average, score_view
from gausslite.evaluation.fitted import render_fitted
from gausslite.evaluation.pictures import comparison_sheet
from gausslite.evaluation.views import HeldOutView, MapViewer, largest_roi_views
from gausslite.render.rasterizer import Rasterizer


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutFrames:
    """Held-out frames: positions of a source at one size (width, height)."""

    source: Source
    positions: Sequence[int]
    size: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class TeamScores:
    """Scores by map name, and a few side-by-side sheets by frame number."""

    scores: dict[str, MapScores]
    sheets: dict[str, UInt8[ndarray, "_ _ 3"]]


def score_team(
    maps: Mapping[str, Gaussians],
    viewpoints: Iterable[HeldOutFrames],
    regions: Sequence[Region],
    rasterizer: Rasterizer,
    fit_views: bool = False,
    sheets: int = 4,
) -> TeamScores:
    """Draw every map from every view; the sheets show the views with the most of the region, spread over the sequence.

    With fit_views each drawing is in the pose and colours that fit the view (`render_fitted`). Raises InvalidInputError
    without a single view with depth.
    """
    views = [view for point in viewpoints for view in _views(point, regions)]
    if not views:
        raise InvalidInputError("held-out views: expected at least one frame with depth, got none")
    viewers = {name: MapViewer(gaussians, rasterizer) for name, gaussians in maps.items()}
    scores: dict[str, list[ViewScore]] = {name: [] for name in maps}
    shown = largest_roi_views(views, sheets)
    pictures = {}
    for i, view in enumerate(views):
        drawings: dict[str, Float32[ndarray, "h w 3"]] = {}
        for name, viewer in viewers.items():
            drawn = render_fitted(viewer, view.frame) if fit_views else viewer.render_frame(view.frame)
            scores[name].append(score_view(drawn, view))
            drawings[name] = drawn.rgb
        if i in shown:
            pictures[f"{i:03d}-frame-{view.frame.index:06d}"] = comparison_sheet(view, drawings)
    return TeamScores({name: average(listed) for name, listed in scores.items()}, pictures)


def _views(point: HeldOutFrames, regions: Sequence[Region]) -> Iterable[HeldOutView]:
    for position in point.positions:
        frame = point.source.frame(position, point.size)
        if frame.has_depth:
            yield HeldOutView.of(frame, regions)
