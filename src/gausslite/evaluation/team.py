"""Score several maps on the same held-out views: each agent's map and every fusion of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float32, UInt8
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.evaluation.compare import MapScores, ViewScore, average, score_view
from gausslite.evaluation.fitted import render_fitted
from gausslite.evaluation.pictures import comparison_sheet
from gausslite.evaluation.views import HeldOutView, MapViewer, largest_roi_views


@dataclass(frozen=True, slots=True, eq=False)
class TeamScores:
    """Scores by map name, and a few comparison sheets by frame number."""

    scores: dict[str, MapScores]
    sheets: dict[str, UInt8[ndarray, "_ _ 3"]]


def score_team(
    viewers: Mapping[str, MapViewer], views: Sequence[HeldOutView], fit_views: bool = False, sheets: int = 4
) -> TeamScores:
    """Return the scores of every map over all held-out views, with comparison sheets of `sheets` views.

    The sheets show the views with the largest region, spread over the sequence. With fit_views, each rendering uses
    the fitted pose and exposure (`render_fitted`). Raises InvalidInputError if there are no views.
    """
    if not views:
        raise InvalidInputError("held-out views: expected at least one frame with depth, got none")
    scores: dict[str, list[ViewScore]] = {name: [] for name in viewers}
    shown = largest_roi_views(views, sheets)
    pictures = {}
    for i, view in enumerate(views):
        renderings: dict[str, Float32[ndarray, "h w 3"]] = {}
        for name, viewer in viewers.items():
            rendering = render_fitted(viewer, view.frame) if fit_views else viewer.render_frame(view.frame)
            scores[name].append(score_view(rendering, view))
            renderings[name] = rendering.rgb
        if i in shown:
            pictures[f"{i:03d}-frame-{view.frame.index:06d}"] = comparison_sheet(view, renderings)
    return TeamScores({name: average(view_scores) for name, view_scores in scores.items()}, pictures)
