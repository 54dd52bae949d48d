"""Compare the runs at the same views: photograph, rendering, detail, difference and kappa, one column for each run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.codec.keyframe_views import KeyframeView
from gausslite.codec.view_images import ViewImage
from gausslite.domain.gaussians import Gaussians
from gausslite.evaluation.metrics import psnr, ssim
from gausslite.evaluation.pictures import (
    DIFFERENCE_GAIN,
    components_to_show,
    crop_component,
    dim_outside,
    outline_roi,
    to_uint8,
)
from gausslite.evaluation.views import MIN_ROI_PIXELS, MapViewer, view_map
from gausslite.report.elements import element, picture, styled
from gausslite.report.run_results import RunResults
from gausslite.view.colours import ColourMode, colours_of, legend_of
from gausslite.view.contents import ViewContents

_MAX_VIEWS = 4
_MAX_WIDTH_PX = 640


@dataclass(frozen=True, slots=True, eq=False)
class SharedView:
    """A photograph at which all runs of one world frame are rendered.

    recorder: the name of the run that kept the photograph. view: the camera and pose of that run. source: the sequence
    that holds the frame, empty if unknown.
    """

    recorder: str
    source: str
    image: ViewImage
    view: KeyframeView

    def pose_of(self, run: RunResults) -> Float64[ndarray, "4 4"]:
        """Return T_world_camera: the run's own refined pose if it kept this frame, else that of the photograph."""
        if self.source and _source_of(run) == self.source:
            for own in run.contents.keyframes:
                if own.index == self.image.index:
                    return own.T_world_camera
        return self.view.T_world_camera


def kappa_gaussians(contents: ViewContents) -> Gaussians:
    """Return the map in the colours of kappa, as in the live view."""
    return replace(contents.gaussians, rgb=(colours_of(contents, ColourMode.KAPPA) / 255).astype(np.float32))


def kappa_legend(contents: ViewContents) -> Element:
    """Return the colours of kappa with their values."""
    entries = []
    for name, (red, green, blue) in legend_of(contents, ColourMode.KAPPA):
        swatch = element("span", attributes={"class": "swatch", "style": f"background:rgb({red},{green},{blue})"})
        entries.append(styled("span", "legend-entry", swatch, name))
    return styled("div", "legend", *entries)


def shared_views(runs: Sequence[RunResults]) -> list[SharedView]:
    """Return at most four views by frame index; those with a region come first, and the runs take turns."""
    found: dict[tuple[str, int], tuple[int, SharedView]] = {}
    for run in runs:
        by_index = {view.index: view for view in run.contents.keyframes}
        for turn, image in enumerate(run.views):
            view = by_index.get(image.index)
            if view is None or image.roi.shape != (view.camera.height_px, view.camera.width_px):
                continue
            source = _source_of(run)
            # without a known sequence, equal indices of two runs are different frames
            key = (source or str(run.map_file), image.index)
            if key not in found or image.roi.sum() > found[key][1].image.roi.sum():
                found[key] = turn, SharedView(run.name, source, image, view)
    ranked = sorted(found.values(), key=lambda each: (not each[1].image.roi.any(), each[0]))[:_MAX_VIEWS]
    return sorted((view for _, view in ranked), key=lambda each: each.image.index)


def _source_of(run: RunResults) -> str:
    """Return the run's sequence; empty for agents, which report none."""
    return str(run.report.get("source") or "")


def view_sections(runs: Sequence[RunResults], views: Sequence[SharedView]) -> list[Element]:
    """Return a grid for each view, with a column for the photograph and one for each run."""
    colour = {run.name: view_map(run.contents.gaussians) for run in runs}
    kappa = {run.name: view_map(kappa_gaussians(run.contents)) for run in runs}
    return [_section(runs, view, colour, kappa) for view in views]


def _section(
    runs: Sequence[RunResults], view: SharedView, colour: Mapping[str, MapViewer], kappa: Mapping[str, MapViewer]
) -> Element:
    image = view.image
    component = next(iter(components_to_show(image.roi)), None) if image.roi.any() else None
    columns = [_photograph_cells(image, component)]
    for run in runs:
        T = view.pose_of(run)
        rendering = colour[run.name].render(view.view.camera, T).rgb
        heat = kappa[run.name].render(view.view.camera, T).rgb
        columns.append(_run_cells(run.name, image, rendering, heat, component))
    # row by row, so that equal pictures are next to each other in the grid
    cells = [cell for row in zip(*columns, strict=True) for cell in row]
    grid = element("div", *cells, attributes={"class": "grid", "style": f"--columns:{len(columns)}"})
    recorder = [styled("span", "muted", f" photograph kept by {view.recorder}")] if len(runs) > 1 else []
    return element("section", element("h3", f"Frame {image.index}", *recorder), grid)


def _photograph_cells(image: ViewImage, component: Bool[ndarray, "h w"] | None) -> list[Element]:
    cells = [_figure(outline_roi(image.photograph, image.roi), "photograph")]
    if component is not None:
        cells.append(_figure(crop_component(image.photograph, component), "photograph: detail"))
        cells.append(_figure(dim_outside(image.photograph, image.roi), "the task's region"))
    else:
        cells.append(styled("div", "empty", "no region of a task in this view"))
    cells.append(styled("div", "empty", "kappa: training updates of the region (see the legend of each run)"))
    return cells


def _run_cells(
    name: str,
    image: ViewImage,
    rendering: Float32[ndarray, "h w 3"],
    heat: Float32[ndarray, "h w 3"],
    component: Bool[ndarray, "h w"] | None,
) -> list[Element]:
    rendered = to_uint8(rendering)
    difference = to_uint8(DIFFERENCE_GAIN * np.abs(rendering - image.photograph / np.float32(255)))
    cells = [_figure(outline_roi(rendered, image.roi), f"{name}: {_scores_text(image, rendering)}")]
    if component is not None:
        cells.append(_figure(crop_component(rendered, component), f"{name}: detail"))
    cells.append(_figure(outline_roi(difference, image.roi), f"{name}: difference ×{DIFFERENCE_GAIN:g}"))
    cells.append(_figure(outline_roi(to_uint8(heat), image.roi), f"{name}: kappa"))
    return cells


def _scores_text(image: ViewImage, rendering: Float32[ndarray, "h w 3"]) -> str:
    full = f"image {psnr(rendering, image.photograph):.1f} dB, SSIM {ssim(rendering, image.photograph):.3f}"
    if np.count_nonzero(image.roi) < MIN_ROI_PIXELS:
        return full
    region = psnr(rendering, image.photograph, image.roi), ssim(rendering, image.photograph, image.roi)
    return f"region {region[0]:.1f} dB, SSIM {region[1]:.3f}; {full}"


def _figure(image: UInt8[ndarray, "h w 3"], caption: str) -> Element:
    import cv2

    height, width = image.shape[:2]
    if width > _MAX_WIDTH_PX:
        size = (_MAX_WIDTH_PX, max(1, round(height * _MAX_WIDTH_PX / width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return picture(image, caption)
