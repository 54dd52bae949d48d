"""The pictures of the report: the map from above, equal views of all runs, bars and lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.pose import upward_axis
from gausslite.domain.relevance import MIN_ROI_PIXELS
from gausslite.render.map_viewer import MapViewer, view_map
from gausslite_evaluation.metrics import psnr, ssim
from gausslite_evaluation.pictures import (
    DIFFERENCE_GAIN,
    components_to_show,
    crop_component,
    dim_outside,
    outline_roi,
    to_uint8,
)
from gausslite_view.contents import ColourMode, ViewContents, colours_of, legend_of, object_boxes
from gausslite_view.oriented_box import OrientedBox
from gausslite_view.report_elements import element, picture, picture_url, styled
from gausslite_view.report_parts import RunResults
from gausslite_view.view_images import ViewImage

_WIDTH_PX, _MAX_HEIGHT_PX = 480, 640
_MARGIN_M = 0.3
_DISTANCE_M = 100.0
"""Height of the camera above the map: the perspective differs from a parallel projection by a few percent."""
_MIN_OPACITY = 0.3
_BORDER_PERCENT = 1.0
_CEILING_PERCENTILE = 90.0
_ABOVE_CAMERA_M = 0.2
_MIN_EXTENT_M = 0.5
_MAX_PATH_POINTS = 400
_LABEL_GAP_PX = 4
_SCALES_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlanCamera:
    """A camera far above the map that looks down; maps of one world frame share it, so that their plans are aligned."""

    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    ceiling_m: float

    @classmethod
    def above(cls, contents: Sequence[ViewContents]) -> PlanCamera | None:
        """Return a camera that shows all maps; None if they hold no visible Gaussian."""
        axes = _plan_axes(contents)
        clouds = [content.gaussians.means_m[content.gaussians.opacities > _MIN_OPACITY] for content in contents]
        points = np.concatenate([cloud.astype(np.float64) for cloud in clouds]) @ axes.T
        paths = np.concatenate([content.T_world_camera[:, :3, 3] for content in contents]) @ axes.T
        if not len(points):
            return None
        if len(paths):
            ceiling_m = float(np.percentile(paths[:, 2], _CEILING_PERCENTILE)) + _ABOVE_CAMERA_M
        else:
            ceiling_m = float(np.percentile(points[:, 2], _CEILING_PERCENTILE))
        low, high = np.percentile(points[:, :2], (_BORDER_PERCENT, 100.0 - _BORDER_PERCENT), axis=0)
        if len(paths):
            low, high = np.minimum(low, paths[:, :2].min(axis=0)), np.maximum(high, paths[:, :2].max(axis=0))
        low, high = low - _MARGIN_M, high + _MARGIN_M
        return cls(_camera(high - low), _pose(axes, (low + high) / 2, ceiling_m), ceiling_m)

    def project(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 2"]:
        """Return the pixels of points in world coordinates."""
        p_camera = (points_m - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3]
        x, y = (p_camera[:, :2] / p_camera[:, 2:]).T
        return np.stack(self.camera.pixels(x, y), axis=1)

    def below_ceiling(self, gaussians: Gaussians) -> Bool[ndarray, " n"]:
        """Return which Gaussians are below the ceiling, which would hide the rest."""
        down = self.T_world_camera[:3, 2]
        return np.asarray(gaussians.means_m @ -down < self.ceiling_m, np.bool_)


def plan_view(contents: ViewContents, gaussians: Gaussians, plan: PlanCamera, caption: str) -> Element:
    """Return a figure of Gaussians (the map's, in any colours) from above, with the map's path and objects."""
    viewer: MapViewer = view_map(gaussians.take(plan.below_ceiling(gaussians)))
    rendering = viewer.render(plan.camera, plan.T_world_camera)
    width, height = plan.camera.width_px, plan.camera.height_px
    image = element(
        "image", attributes={"href": picture_url(to_uint8(rendering.rgb)), "width": str(width), "height": str(height)}
    )
    parts = [image, *_path(contents, plan)]
    for landmark, box in zip(contents.objects, object_boxes(contents), strict=True):
        parts += _marked_object(landmark, box, plan)
    drawing = element(
        "svg",
        *parts,
        *_scale_bar(plan.camera),
        attributes={"viewBox": f"0 0 {width} {height}", "role": "img", "aria-label": caption},
    )
    return element("figure", drawing, element("figcaption", caption))


def _plan_axes(contents: Sequence[ViewContents]) -> Float64[ndarray, "3 3"]:
    """Return the plan's right, forward and up as rows: up is the world axis nearest to the cameras' mean up."""
    up = np.array(upward_axis(np.concatenate([content.T_world_camera for content in contents])))
    right = np.eye(3)[1 if up[0] else 0]
    return np.stack([right, np.cross(up, right), up])


def _camera(extent_m: Float64[ndarray, "2"]) -> Camera:
    extent_m = np.maximum(extent_m, _MIN_EXTENT_M)
    px_per_m = min(_WIDTH_PX / extent_m[0], _MAX_HEIGHT_PX / extent_m[1])
    width, height = (max(1, round(float(px_per_m * side))) for side in extent_m)
    return Camera.centred(float(px_per_m * _DISTANCE_M), width, height)


def _pose(axes: Float64[ndarray, "3 3"], centre_m: Float64[ndarray, "2"], ceiling_m: float) -> Float64[ndarray, "4 4"]:
    """Return the pose above the centre: the image's right, down and depth axes are right, -forward and -up."""
    right, forward, up = axes
    T = np.eye(4)
    T[:3, :3] = np.stack([right, -forward, -up], axis=1)
    T[:3, 3] = axes.T @ np.array((centre_m[0], centre_m[1], ceiling_m + _DISTANCE_M))
    return T


def _path(contents: ViewContents, plan: PlanCamera) -> list[Element]:
    positions = contents.T_world_camera[:, :3, 3]
    if not len(positions):
        return []
    shown = positions[np.unique(np.linspace(0, len(positions) - 1, _MAX_PATH_POINTS).astype(int))]
    pixels = plan.project(shown)
    line = {"class": "path", "points": " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)}
    start = {"class": "start", "cx": f"{pixels[0, 0]:.1f}", "cy": f"{pixels[0, 1]:.1f}", "r": "4"}
    return [element("polyline", attributes=line), element("circle", element("title", "start"), attributes=start)]


def _marked_object(landmark: ObjectLandmark, box: OrientedBox, plan: PlanCamera) -> list[Element]:
    """Return the object's box, seen from above, with its name over it."""
    pixels = plan.project(box.corners_m)
    outline = cv2.convexHull(pixels.astype(np.float32))[:, 0].tolist()
    name = {"class": "label", "x": f"{pixels[:, 0].mean():.1f}", "y": f"{pixels[:, 1].min() - _LABEL_GAP_PX:.1f}"}
    role = "target" if landmark.role is ObjectRole.TARGET else "anchor"
    corners = {"class": role, "points": " ".join(f"{x:.1f},{y:.1f}" for x, y in outline)}
    polygon = element("polygon", element("title", landmark.object_id), attributes=corners)
    return [polygon, element("text", landmark.object_id, attributes=name)]


def _scale_bar(camera: Camera) -> list[Element]:
    px_per_m = camera.length_px(1.0, _DISTANCE_M)
    length_m = max(
        [candidate_m for candidate_m in _SCALES_M if candidate_m * px_per_m < camera.width_px / 3], default=_SCALES_M[0]
    )
    x, y = 12, camera.height_px - 12
    points = f"{x},{y - 5} {x},{y} {x + length_m * px_per_m:.1f},{y} {x + length_m * px_per_m:.1f},{y - 5}"
    label = element("text", f"{length_m:g} m", attributes={"class": "label", "x": str(x + 6), "y": str(y - 6)})
    return [element("polyline", attributes={"class": "scale", "points": points}), styled("g", "scale-label", label)]


_WIDTH, _HEIGHT = 460.0, 200.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 10.0, 10.0, 34.0
_MAX_POINTS = 400
_TICKS = 4
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_BAR_HEIGHT, _BAR_GAP, _NAME_WIDTH, _VALUE_WIDTH = 18.0, 6.0, 120.0, 84.0
_MAX_NAME = 18
_COLOURS = ("#2a78b8", "#d9822b", "#3a9d5d", "#b8475a", "#8463b8", "#8a6a4f", "#5b9aa8", "#7a7a7a")


@dataclass(frozen=True, slots=True)
class Line:
    """One run's values: x and y of equal length; y has gaps where it is not finite."""

    colour: str
    x: Float64[ndarray, " n"]
    y: Float64[ndarray, " n"]


def run_colour(index: int) -> str:
    """Return the colour of a run in all plots; after eight runs the colours repeat."""
    return _COLOURS[index % len(_COLOURS)]


def bar_chart(title: str, values: Mapping[str, tuple[str, float]], text_of: Callable[[float], str]) -> Element:
    """Return a figure with one bar for each run. values: colour and value by run name."""
    top = max(max((value for _, value in values.values()), default=0.0), 1e-12)
    space = _WIDTH - _NAME_WIDTH - _VALUE_WIDTH
    parts: list[Element] = []
    for row, (name, (colour, value)) in enumerate(values.items()):
        y = row * (_BAR_HEIGHT + _BAR_GAP)
        length = max(0.0, value / top * space)
        box = {"x": f"{_NAME_WIDTH:g}", "y": f"{y:g}", "width": f"{length:.1f}", "height": f"{_BAR_HEIGHT:g}"}
        short = name if len(name) <= _MAX_NAME else f"{name[: _MAX_NAME - 1]}…"
        parts += [
            _text(short, _NAME_WIDTH - 8, y + 13, "end"),
            element("rect", element("title", name), attributes={**box, "fill": colour}),
            _text(text_of(value), _NAME_WIDTH + length + 6, y + 13, "start"),
        ]
    height = len(values) * (_BAR_HEIGHT + _BAR_GAP)
    return _chart(title, height, parts)


def line_chart(title: str, lines: Mapping[str, Line], text_of: Callable[[float], str]) -> Element:
    """Return a figure with one line for each run over the frame index."""
    x_low, x_high = _range(np.concatenate([line.x for line in lines.values()]))
    values = np.concatenate([line.y for line in lines.values()])
    y_ticks = _tick_values(0.0, max(float(np.max(values, initial=0.0)), 1e-9))
    y_high = y_ticks[-1]
    parts: list[Element] = []
    for tick in y_ticks:
        y = _HEIGHT - _BOTTOM - tick / y_high * (_HEIGHT - _TOP - _BOTTOM)
        grid = {"class": "gridline", "points": f"{_LEFT},{y:.1f} {_WIDTH - _RIGHT},{y:.1f}"}
        parts += [element("polyline", attributes=grid), _text(text_of(tick), _LEFT - 6, y + 4, "end")]
    for frame in (x_low, x_high):
        x = _LEFT + (frame - x_low) / max(x_high - x_low, 1.0) * (_WIDTH - _LEFT - _RIGHT)
        parts.append(_text(f"{frame:.0f}", x, _HEIGHT - _BOTTOM + 16, "start" if frame == x_low else "end"))
    parts.append(_text("frame", (_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 6, "middle"))
    for name, line in lines.items():
        chosen = np.unique(np.linspace(0, len(line.x) - 1, _MAX_POINTS).astype(int))
        xs = _LEFT + (line.x[chosen] - x_low) / max(x_high - x_low, 1.0) * (_WIDTH - _LEFT - _RIGHT)
        ys = _HEIGHT - _BOTTOM - line.y[chosen] / y_high * (_HEIGHT - _TOP - _BOTTOM)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
        attributes = {"class": "line", "points": points, "stroke": line.colour}
        parts.append(element("polyline", element("title", name), attributes=attributes))
    return _chart(title, _HEIGHT, parts)


def run_legend(colours: Mapping[str, str]) -> Element:
    """Return the runs' names with their colours."""
    entries = [
        styled(
            "span", "legend-entry", element("span", attributes={"class": "swatch", "style": f"background:{c}"}), name
        )
        for name, c in colours.items()
    ]
    return styled("div", "legend", *entries)


def _chart(title: str, height: float, parts: list[Element]) -> Element:
    attributes = {"viewBox": f"0 0 {_WIDTH:g} {height:g}", "role": "img", "aria-label": title, "class": "chart"}
    return element("figure", element("figcaption", title), element("svg", *parts, attributes=attributes))


def _text(text: str, x: float, y: float, anchor: str) -> Element:
    return element("text", text, attributes={"x": f"{x:.1f}", "y": f"{y:.1f}", "text-anchor": anchor})


def _range(values: Float64[ndarray, " n"]) -> tuple[float, float]:
    return float(np.min(values)), float(np.max(values))


def _tick_values(low: float, high: float) -> list[float]:
    """Return about four round values that cover the range from low to high."""
    raw = (high - low) / _TICKS
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * magnitude for factor in _STEPS if factor * magnitude >= raw * (1 - 1e-9))
    count = math.ceil((high - low) / step - 1e-9)
    return [low + i * step for i in range(count + 1)]


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


def coloured_gaussians(contents: ViewContents, mode: ColourMode) -> Gaussians:
    """Return the map in the colours of a mode, as in the live view."""
    return replace(contents.gaussians, rgb=(colours_of(contents, mode) / 255).astype(np.float32))


def colour_legend(contents: ViewContents, mode: ColourMode) -> Element:
    """Return the colours of a mode with their meanings."""
    entries = []
    for name, (red, green, blue) in legend_of(contents, mode):
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
    kappa = {run.name: view_map(coloured_gaussians(run.contents, ColourMode.KAPPA)) for run in runs}
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
