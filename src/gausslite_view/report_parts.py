"""The tables of the report: results folders, figures with units, tasks, nouns, objects and notes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.ply import read_ply, read_world_frame
from gausslite.domain.errors import MapFileError
from gausslite.domain.objects import ObjectLandmark
from gausslite.mission.results import EVALUATION, read_json, read_report
from gausslite.process import print_message, size_text
from gausslite_evaluation.compare import TEAM_MAP
from gausslite_evaluation.lpips import NAME as LPIPS_NAME
from gausslite_view.contents import ViewContents, object_boxes, with_agents
from gausslite_view.oriented_box import OrientedBox
from gausslite_view.report_elements import element, styled
from gausslite_view.run_contents import read_contents
from gausslite_view.timeline import read_timeline
from gausslite_view.view_images import ViewImage, read_view_images

_MAP, _PICTURES = "map.ply", "pictures"
_FUSED_MAPS = ("concatenation", "vote", "refine")


@dataclass(frozen=True, slots=True, eq=False)
class RunResults:
    """One map with its reports: one column of the page.

    report: report.json. scores: figures on held-out views by name, empty if the map was not scored. timeline: the
    columns of frames.csv. views: photographs of keyframes. notes: what could not be read. Any but the map may be
    empty.
    """

    name: str
    map_file: Path
    contents: ViewContents
    world_frame: str
    report: Mapping[str, object] = field(default_factory=dict)
    scores: Mapping[str, object] = field(default_factory=dict)
    timeline: Mapping[str, Float64[ndarray, " n"]] = field(default_factory=dict)
    views: Sequence[ViewImage] = ()
    notes: Sequence[str] = ()

    @property
    def map_bytes(self) -> int:
        """Size of the map file."""
        return self.map_file.stat().st_size


@dataclass(frozen=True, slots=True)
class ReportContents:
    """The names of the folders, the columns of the page, and the comparison sheets (PNG files) with their captions."""

    folders: Sequence[str]
    runs: Sequence[RunResults]
    sheets: Mapping[Path, str]


def read_results(folders: Sequence[Path]) -> ReportContents:
    """Read the folders; that of a demo gives one column for each agent and for each fused map.

    Raises MapFileError for a folder without a run, CodecError, DatasetError, PoseError.
    """
    names = _distinct_names(folders)
    runs: list[RunResults] = []
    sheets: dict[Path, str] = {}
    for folder, name in zip(folders, names, strict=True):
        report = read_report(folder)
        if isinstance(report.get("agents"), Mapping) and isinstance(report.get("maps"), Mapping):
            found = _read_team(folder, report)
        elif (folder / _MAP).is_file():
            found = [_read_run(folder, name)]
        else:
            raise MapFileError(f"{folder}: expected a results folder of `map`, `demo` or an agent, got none")
        several = len(folders) > 1 and len(found) > 1
        runs += [replace(run, name=f"{name} {run.name}") for run in found] if several else found
        sheets |= {path: f"{name}: {path.stem}" for path in sorted((folder / _PICTURES).glob("*.png"))}
    return ReportContents(names, runs, sheets)


def _read_evaluation(folder: Path) -> Mapping[str, object]:
    """Return the content of evaluation.json; empty without it. Raises MapFileError for a damaged file."""
    path = folder / EVALUATION
    scores = read_json(path)
    if not scores and path.exists():
        raise MapFileError(f"{path}: expected the scores of `gausslite eval`, got something else")
    return scores


def _read_run(folder: Path, name: str, scores: Mapping[str, object] | None = None) -> RunResults:
    report, file = read_report(folder), folder / _MAP
    if not report and (folder / "report.json").exists():
        raise MapFileError(f"{folder}/report.json: expected the report of a run, got something else")
    notes = []
    if scores is None:
        try:
            scores = _read_evaluation(folder)
        except MapFileError as error:
            scores = {}
            notes.append(f"{error}; the page has no scores of it")
    return RunResults(
        name=name,
        map_file=file,
        contents=read_contents(folder),
        world_frame=read_world_frame(file),
        report=report,
        scores=scores,
        timeline=read_timeline(folder),
        views=read_view_images(folder),
        notes=notes,
    )


def _read_team(folder: Path, report: Mapping[str, object]) -> list[RunResults]:
    """Return the agents' maps, and the fused maps with all agents' objects."""
    agents, maps = report["agents"], report["maps"]
    assert isinstance(agents, Mapping)
    assert isinstance(maps, Mapping)
    # a name is a folder's name: it must not lead out of the results folder
    present = [str(name) for name in agents if _is_plain(str(name)) and (folder / str(name) / _MAP).is_file()]
    if not present:
        raise MapFileError(f"{folder}: expected a folder with {_MAP} for each agent of report.json, got none")
    runs = [_read_run(folder / name, name, _mapping(maps.get(name))) for name in present]
    objects = tuple(landmark for run in runs for landmark in run.contents.objects)
    own = {run.name: run.contents.gaussians for run in runs}
    for name in _FUSED_MAPS:
        file = folder / f"{name}.ply"
        if file.is_file():
            contents = replace(ViewContents.of_one_agent(read_ply(file, print_message)), objects=objects)
            if name == TEAM_MAP:
                contents = with_agents(contents, own)
            runs.append(RunResults(name, file, contents, read_world_frame(file), {}, _mapping(maps.get(name))))
    return runs


def _distinct_names(folders: Sequence[Path]) -> list[str]:
    """Return the folders' names; if two are equal, the paths as they were given."""
    names = [folder.resolve().name or str(folder) for folder in folders]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]


def _is_plain(name: str) -> bool:
    return name not in ("", ".", "..") and "/" not in name and "\0" not in name


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


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
    items = value if isinstance(value, list) else [value]
    text = ", ".join(as_count(item) if type(item) is int else str(item) for item in items)
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 1]}…"


def as_count(value: float) -> str:
    """Return a whole number with separated thousands."""
    return f"{value:,.0f}"


def as_percent(value: float) -> str:
    """Return a share in percent."""
    return f"{100 * value:.3g} %"


def as_seconds(value: float) -> str:
    """Return a duration in seconds."""
    return f"{value:.3g} s" if value < 1000 else f"{value:.0f} s"


def as_decibels(value: float) -> str:
    """Return a PSNR."""
    return f"{value:.2f} dB"


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
    Figure("region SSIM", _of_scores("roi_ssim"), "{:.3f}".format),
    Figure("image PSNR", _of_scores("full_psnr"), as_decibels),
    Figure("image SSIM", _of_scores("full_ssim"), "{:.3f}".format),
    Figure(f"region {LPIPS_NAME}", _of_scores("roi_lpips"), "{:.3f}".format),
    Figure("region depth error", _of_scores("roi_depth_l1_m"), "{:.3f} m".format),
    Figure("image depth error", _of_scores("full_depth_l1_m"), "{:.3f} m".format),
    Figure("region covered", _of_scores("roi_covered"), as_percent),
    Figure("scored views", _of_scores("n_views"), as_count),
    Figure("of them with the region", _of_scores("n_roi_views"), as_count),
)
MAP_SIZE = (
    Figure("Gaussians", lambda run: float(len(run.contents.gaussians)), as_count),
    Figure("Gaussians of the region", lambda run: float(run.contents.gaussians.active.sum()), as_count),
    Figure("map file", lambda run: float(run.map_bytes), size_text),
    Figure("sent to the fusion server", _of_report("bytes_sent"), size_text),
    Figure("share of the map sent", _shared, as_percent),
    Figure("rest of the map, sent at the end", _of_report("handover_bytes"), size_text),
    Figure("keyframes sent", _of_report("keyframe_bytes"), size_text),
)
TIMES = (
    Figure("frames mapped", _of_report("frames"), as_count),
    Figure("frames skipped", _of_report("frames_skipped"), as_count),
    Figure("frames dropped", _of_report("frames_dropped"), as_count),
    Figure("frames corrupt", _of_report("frames_corrupt"), as_count),
    Figure("frame rate", _of_report("hz"), "{:.2f} Hz".format),
    Figure("total time", _of_report("seconds"), as_seconds),
    Figure("frame age, median", _of_report("frame_age_p50_s"), as_seconds),
    Figure("frame age, 99th percentile", _of_report("frame_age_p99_s"), as_seconds),
    Figure("training iterations", _of_report("iterations"), as_count),
    Figure("region's share of the pixels, mean", _of_report("roi_share"), as_percent),
    Figure("peak memory", _of_report("peak_rss_mib"), "{:.0f} MiB".format),
    Figure("trajectory error (RMSE)", _path_error_m, "{:.3f} m".format),
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
    body = [
        element(
            "tr", *(element("td", text, attributes={"title": name}) for name, text in zip(header, row, strict=True))
        )
        for row in rows
    ]
    return styled("div", "scroll", styled("table", "list", element("thead", head), element("tbody", *body)))


_OBJECT_HEADER = ("run", "object", "role", "centre x y z (m)", "size x y z (m)", "confidence")
_NOUN_HEADER = ("run", "noun", "searched as", "how", "detections", "best score", "objects confirmed")


def task_column(run: RunResults) -> Element:
    """Return the run's tasks with their graphs, and its notes."""
    task, switches = run.report.get("task"), run.report.get("then")
    parts = [_task(task, run.report)] if task else [_without_task(run.report)]
    for switch in switches if isinstance(switches, list) else []:
        if isinstance(switch, Mapping):
            parts += [styled("p", "muted", f"from frame {short_text(switch.get('frame'))}:"), _task(switch, {})]
    notes = run.report.get("notes")
    if isinstance(notes, list) and notes:
        parts.append(styled("ul", "notes", *(element("li", short_text(note)) for note in notes)))
    if run.report.get("stopped_by"):
        parts.append(styled("p", "notes", f"ended early: {short_text(run.report.get('stopped_by'))}"))
    return styled("div", "card", element("h3", run.name), *parts)


def objects_table(runs: Sequence[RunResults]) -> Element | None:
    """Return the objects of all runs with their positions; None without any. Fused maps repeat those of the agents."""
    rows = [
        _object_row(run.name, *found)
        for run in runs
        if run.report
        for found in zip(run.contents.objects, object_boxes(run.contents), strict=True)
    ]
    return list_table(_OBJECT_HEADER, rows) if rows else None


def nouns_table(runs: Sequence[RunResults]) -> Element | None:
    """Return what was searched and detected for each noun; None without any."""
    rows = []
    for run in runs:
        nouns = run.report.get("nouns")
        rows += (
            [_noun_row(run.name, noun) for noun in nouns if isinstance(noun, Mapping)]
            if isinstance(nouns, list)
            else []
        )
    return list_table(_NOUN_HEADER, rows) if rows else None


def _without_task(report: Mapping[str, object]) -> Element:
    is_uniform = report.get("policy") == "uniform"
    return element(
        "p", "no task: the whole scene gets equal detail" if is_uniform else "no sentence: known regions, or none"
    )


def _task(task: object, report: Mapping[str, object]) -> Element:
    """Return a task's sentence and its graph, which an agent's report holds apart."""
    if not isinstance(task, Mapping):
        graph = report.get("task_graph")
        task = {**(graph if isinstance(graph, Mapping) else {}), "text": task}
    relations = task.get("relations")
    lines = (
        [_relation(relation) for relation in relations if isinstance(relation, Mapping)]
        if isinstance(relations, list)
        else []
    )
    return styled(
        "div",
        "task",
        styled("blockquote", "sentence", short_text(task.get("text"))),
        _chips("target", task.get("targets")),
        _chips("anchor", task.get("anchors")),
        *lines,
    )


def _chips(role: str, nouns: object) -> Element:
    listed = nouns if isinstance(nouns, list) else []
    chips = [styled("span", f"chip {role}", short_text(noun)) for noun in listed]
    return styled("div", "chips", *([styled("span", "muted", f"{role}s: "), *chips] if chips else []))


def _relation(relation: Mapping[str, object]) -> Element:
    target, anchor = short_text(relation.get("target")), short_text(relation.get("anchor"))
    arrow = styled("span", "predicate", short_text(relation.get("predicate")).replace("_", " "))
    return styled(
        "div", "relation", styled("span", "chip target", target), arrow, styled("span", "chip anchor", anchor)
    )


def _object_row(run: str, landmark: ObjectLandmark, box: OrientedBox) -> list[str]:
    centre = "  ".join(f"{value:.2f}" for value in landmark.centroid_m)
    size = " × ".join(f"{value:.2f}" for value in box.size_m)
    return [run, landmark.object_id, str(landmark.role), centre, size, f"{landmark.confidence:.2f}"]


def _noun_row(run: str, noun: Mapping[str, object]) -> list[str]:
    score = number(noun.get("best_score"))
    found = [short_text(noun.get(key)) or "0" for key in ("detections", "confirmed_objects")]
    searched = short_text(noun.get("classes")) if noun.get("searched") else "not searched"
    best = "–" if score is None else f"{score:.2f}"
    return [run, short_text(noun.get("noun")), searched, short_text(noun.get("basis")), found[0], best, found[1]]
