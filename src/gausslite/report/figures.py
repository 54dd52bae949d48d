"""Choose the figures of a run that people compare, and write them with units."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from gausslite.report.elements import element, styled
from gausslite.report.run_results import RunResults

_MAX_TEXT = 300
_MISSING = "–"


@dataclass(frozen=True, slots=True)
class Figure:
    """One row of a table. value: of a run, None without one; text: the value for people."""

    label: str
    value: Callable[[RunResults], float | None]
    text: Callable[[float], str]


def number(value: object) -> float | None:
    """Return a finite number of a report; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def short_text(value: object) -> str:
    """Return a value of a report as text of limited length; empty for None, empty lists and empty objects."""
    if value is None or value in ([], {}, ""):
        return ""
    text = ", ".join(str(each) for each in value) if isinstance(value, list) else str(value)
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 1]}…"


def as_count(value: float) -> str:
    """Return a whole number with separated thousands."""
    return f"{value:,.0f}".replace(",", " ")


def as_bytes(value: float) -> str:
    """Return a size with the unit that fits."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value >= factor:
            return f"{value / factor:.3g} {unit}"
    return f"{value:.0f} B"


def as_percent(value: float) -> str:
    """Return a share in percent."""
    return f"{100 * value:.3g} %"


def as_seconds(value: float) -> str:
    """Return a duration in seconds."""
    return f"{value:.3g} s" if value < 1000 else f"{value:.0f} s"


def as_decibels(value: float) -> str:
    """Return a PSNR."""
    return f"{value:.2f} dB"


def _plain(value: float) -> str:
    return f"{value:.3g}"


def _similarity(value: float) -> str:
    return f"{value:.3f}"


def _hertz(value: float) -> str:
    return f"{value:.2f} Hz"


def _metres(value: float) -> str:
    return f"{value:.3f} m"


def _mebibytes(value: float) -> str:
    return f"{value:.0f} MiB"


def _of_report(key: str) -> Callable[[RunResults], float | None]:
    return lambda run: number(run.report.get(key))


def _of_scores(key: str) -> Callable[[RunResults], float | None]:
    return lambda run: number(run.scores.get(key))


def _shared(run: RunResults) -> float | None:
    percent = number(run.report.get("map_shared_percent"))
    return None if percent is None else percent / 100


def _path_error_m(run: RunResults) -> float | None:
    error = run.report.get("ate")
    return number(error.get("rmse_m")) if isinstance(error, Mapping) else None


SCORES = (
    Figure("region PSNR", _of_scores("roi_psnr"), as_decibels),
    Figure("region SSIM", _of_scores("roi_ssim"), _similarity),
    Figure("image PSNR", _of_scores("full_psnr"), as_decibels),
    Figure("image SSIM", _of_scores("full_ssim"), _similarity),
    Figure("region LPIPS", _of_scores("roi_lpips"), _similarity),
    Figure("region depth error", _of_scores("roi_depth_l1_m"), _metres),
    Figure("image depth error", _of_scores("full_depth_l1_m"), _metres),
    Figure("region covered", _of_scores("roi_covered"), as_percent),
    Figure("scored views", _of_scores("n_views"), as_count),
    Figure("of them with the region", _of_scores("n_roi_views"), as_count),
)
MAP_SIZE = (
    Figure("Gaussians", lambda run: float(len(run.contents.gaussians)), as_count),
    Figure("Gaussians of the region", lambda run: float(run.contents.gaussians.active.sum()), as_count),
    Figure("map file", lambda run: float(run.map_bytes), as_bytes),
    Figure("sent to the fusion server", _of_report("bytes_sent"), as_bytes),
    Figure("share of the map sent", _shared, as_percent),
    Figure("rest of the map, sent at the end", _of_report("handover_bytes"), as_bytes),
    Figure("keyframes sent", _of_report("keyframe_bytes"), as_bytes),
)
TIMES = (
    Figure("frames mapped", _of_report("frames"), as_count),
    Figure("frames skipped", _of_report("frames_skipped"), as_count),
    Figure("frames dropped", _of_report("frames_dropped"), as_count),
    Figure("frames corrupt", _of_report("frames_corrupt"), as_count),
    Figure("frame rate", _of_report("hz"), _hertz),
    Figure("total time", _of_report("seconds"), as_seconds),
    Figure("frame age, median", _of_report("frame_age_p50_s"), as_seconds),
    Figure("frame age, 99th percentile", _of_report("frame_age_p99_s"), as_seconds),
    Figure("training iterations", _of_report("iterations"), as_count),
    Figure("region's share of the pixels, mean", _of_report("roi_share"), as_percent),
    Figure("peak memory", _of_report("peak_rss_mib"), _mebibytes),
    Figure("trajectory error (RMSE)", _path_error_m, _metres),
)
SETTINGS = {
    "source": "source",
    "policy": "policy",
    "switched off": "without",
    "poses": "poses",
    "image size": "size",
    "most Gaussians": "max_gaussians",
    "seed": "seed",
    "held out: every N-th frame": "hold_out",
    "depth registration": "colour_camera",
    "camera correction": "camera_correction",
    "pose prior": "view_error",
    "ended early": "stopped_by",
}
"""Labels with the keys of report.json."""


def figures_table(runs: Sequence[RunResults], figures: Sequence[Figure]) -> Element | None:
    """Return a table with a column for each run that has one of the figures; None if no run has."""
    columns = [run for run in runs if any(figure.value(run) is not None for figure in figures)]
    rows = []
    for figure in figures:
        values = [figure.value(run) for run in columns]
        if any(value is not None for value in values):
            texts = [_MISSING if value is None else figure.text(value) for value in values]
            rows.append((figure.label, texts))
    return comparison_table(columns, rows, "figures") if rows else None


def settings_table(runs: Sequence[RunResults]) -> Element | None:
    """Return a table of how the maps were made; None if no run states it."""
    rows = []
    for label, key in SETTINGS.items():
        texts = [short_text(run.report.get(key)) for run in runs]
        if any(texts):
            rows.append((label, [text or _MISSING for text in texts]))
    rows.append(("world frame", [run.world_frame or _MISSING for run in runs]))
    return comparison_table(runs, rows, "settings")


def comparison_table(runs: Sequence[RunResults], rows: Sequence[tuple[str, Sequence[str]]], style: str) -> Element:
    """Return a table with a header of the runs' names and one row for each label."""
    head = element("tr", element("th"), *(element("th", run.name) for run in runs))
    body = [element("tr", element("th", label), *(element("td", text) for text in texts)) for label, texts in rows]
    return styled("div", "scroll", styled("table", style, element("thead", head), element("tbody", *body)))


def list_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Element:
    """Return a table with one row for each entry."""
    head = element("tr", *(element("th", text) for text in header))
    body = [element("tr", *(element("td", text) for text in row)) for row in rows]
    return styled("div", "scroll", styled("table", "list", element("thead", head), element("tbody", *body)))
