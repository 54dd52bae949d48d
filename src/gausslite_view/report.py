"""Assemble the page: one self-contained HTML file without scripts and without requests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import StorageError
from gausslite.domain.objects import found_text
from gausslite_evaluation.compare import MAP_PURPOSES, team_sentence
from gausslite_view.contents import ColourMode
from gausslite_view.report_elements import as_html, element, picture, styled
from gausslite_view.report_parts import (
    MAP_SIZE,
    SCORES,
    TIMES,
    Figure,
    ReportContents,
    RunResults,
    as_count,
    as_decibels,
    as_percent,
    as_seconds,
    figures_table,
    nouns_table,
    number,
    objects_table,
    read_results,
    settings_table,
    short_text,
    task_column,
)
from gausslite_view.report_pictures import (
    Line,
    PlanCamera,
    bar_chart,
    colour_legend,
    coloured_gaussians,
    line_chart,
    plan_view,
    run_colour,
    run_legend,
    shared_views,
    view_sections,
)
from gausslite_view.view_images import read_png

_GENERATOR = "gausslite report"
# the browser itself refuses every request and every script
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_HEAD_BYTES = 512
_OPEN_SHEETS = 2
_SHEET_WIDTH_PX = 800
_BARS = (("region PSNR", SCORES[0]), ("image PSNR", SCORES[2]), ("Gaussians", MAP_SIZE[0]), ("frame rate", TIMES[4]))
_LINES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("time of each frame", "seconds", as_seconds),
    ("Gaussians after each frame", "gaussians", as_count),
    ("region's share of the pixels", "roi_share", as_percent),
    ("training iterations of each frame", "iterations", as_count),
    ("place of the robot: 0 tracked, 1 doubtful, 2 lost", "localisation", as_count),
)


def write_report(path: Path, folders: Sequence[Path]) -> None:
    """Write the page of results folders. Raises MapFileError for a folder without a run, StorageError."""
    write_page(path, read_results(folders))


def write_page(path: Path, contents: ReportContents) -> int:
    """Write the page and return its size in bytes. Raises StorageError, MapFileError for a damaged picture."""
    data = as_html(_document(contents))
    write_atomic(path, data)
    return len(data)


def require_replaceable(path: Path) -> None:
    """Raise StorageError if the path holds anything but a page of this kind."""
    if path.is_dir():
        raise StorageError(f"{path}: expected the name of a file, got a folder")
    if path.exists() and _GENERATOR.encode() not in _first_bytes(path):
        raise StorageError(f"{path} exists already and is not a report; choose another --out")


def _document(contents: ReportContents) -> Element:
    title = f"GaussLite: {', '.join(contents.folders)}"
    metadata: tuple[dict[str, str], ...] = (
        {"charset": "utf-8"},
        {"name": "generator", "content": _GENERATOR},
        {"http-equiv": "Content-Security-Policy", "content": _POLICY},
        {"name": "viewport", "content": "width=device-width, initial-scale=1"},
    )
    head = element(
        "head",
        *(element("meta", attributes=attributes) for attributes in metadata),
        element("title", title),
        element("style", (files("gausslite_view") / "page.css").read_text()),
    )
    body = element("body", element("h1", title), *_sections(contents))
    return element("html", head, body, attributes={"lang": "en"})


def _sections(contents: ReportContents) -> Iterator[Element]:
    """Yield one sentence for each run, the pictures, the figures, and then how the maps were made."""
    runs = contents.runs
    colours = {run.name: run_colour(i) for i, run in enumerate(runs)}
    yield styled("div", "lead", *(element("p", sentence) for sentence in _lead_sentences(runs)))
    for group in _by_world_frame(runs):
        if views := shared_views(group):
            sections = view_sections(group, views)
            folded = _folded(sections[1:], "views")
            yield _section("Views", *sections[:1], _view_note(group), *folded, *_kappa_legends(group))
    yield from _score_section(runs)
    yield _section("Task", styled("div", "cards", *(task_column(run) for run in runs if run.report)))
    if tables := _present(objects_table(runs), nouns_table(runs)):
        yield _section("Objects", *tables)
    if contents.sheets:
        sheets = [picture(_as_thumbnail(read_png(path)), caption) for path, caption in contents.sheets.items()]
        shown = [styled("div", "sheets", *part) for part in (sheets[:_OPEN_SHEETS], sheets[_OPEN_SHEETS:]) if part]
        yield _section("Pictures", *shown[:1], *_folded(shown[1:], "pictures", len(sheets) - _OPEN_SHEETS))
    if plans := [_plans(group) for group in _by_world_frame(runs)]:
        yield _section("From above", *_plan_notes(), *plans)
    tables = _present(figures_table(runs, MAP_SIZE), figures_table(runs, TIMES))
    yield _section("Map and time", styled("div", "tables", *tables))
    if charts := [*_bars(runs, colours), *_lines(runs, colours)]:
        yield _section("Plots", run_legend(colours), styled("div", "charts", *charts))
    yield _section("Settings", *_present(settings_table(runs)))


def _lead_sentences(runs: Sequence[RunResults]) -> Iterator[str]:
    """Yield a sentence for each run, and one on what a team gains by fusing, or on the best of several runs."""
    for run in runs:
        if run.report:
            yield f"{run.name}: {_found(run)} {_quality(run)}"
    if gain := team_gain(runs):
        yield gain
    elif best := _best_region(runs):
        yield best


def team_gain(runs: Sequence[RunResults]) -> str:
    """Return what the voted map of a team has and each robot's own map lacks; empty without scores of a team."""
    psnr = {f"the region of {task}": _values(runs, _of_task(task, "roi_psnr")) for task in _tasks(runs)}
    return team_sentence({**psnr, "whole images": _values(runs, lambda run: number(run.scores.get("full_psnr")))})


def _task_figures(runs: Sequence[RunResults]) -> list[Figure]:
    """Return the figures of each task's region alone, for the maps of a team that were scored so."""
    figures = []
    for task in _tasks(runs):
        figures.append(Figure(f"region of {task}, PSNR", _of_task(task, "roi_psnr"), as_decibels))
        figures.append(Figure(f"region of {task}, covered", _of_task(task, "roi_covered"), as_percent))
    return figures


def _found(run: RunResults) -> str:
    """Return what the run was for and what it found."""
    gaussians = run.contents.gaussians
    size = f"{as_count(len(gaussians))} Gaussians"
    task = run.report.get("task")
    text = short_text(task.get("text") if isinstance(task, Mapping) else task)
    in_region = f"{size}, {as_count(int(gaussians.active.sum()))} of them in its region."
    if text:
        found = found_text(run.contents.objects, run.contents.targets, gaussians.means_m[gaussians.active])
        return f"for \u201c{text}\u201d it found {found}; {in_region}"
    if gaussians.active.any():
        return f"the map of a known region has {in_region}"
    return f"the map without a task has {size}."


def _quality(run: RunResults) -> str:
    own_region = _of_task(run.name, "roi_psnr")(run)
    region = own_region if _of_tasks(run) else number(run.scores.get("roi_psnr"))
    image = number(run.scores.get("full_psnr"))
    views = number(run.scores.get("n_views"))
    if image is None or views is None:
        return "It was not scored on views that it has not seen."
    in_region = "" if region is None else f"its region has {as_decibels(region)} PSNR and "
    return f"On {as_count(views)} scored views {in_region}the whole images have {as_decibels(image)}."


def _best_region(runs: Sequence[RunResults]) -> str:
    """Return which of several runs shows the region best, if they were scored on equally many views."""
    known = {run.name: value for run in runs if (value := number(run.scores.get("roi_psnr"))) is not None}
    if len(known) < 2 or len({run.scores.get("n_views") for run in runs if run.name in known}) > 1:
        return ""
    first, second = sorted(known, key=known.__getitem__, reverse=True)[:2]
    gain_db = known[first] - known[second]
    return f"The region is best in {first}: {as_decibels(gain_db)} more than in {second}."


def _of_tasks(run: RunResults) -> Mapping[str, object]:
    tasks = run.scores.get("tasks")
    return tasks if isinstance(tasks, Mapping) else {}


def _of_task(task: str, key: str) -> Callable[[RunResults], float | None]:
    def value(run: RunResults) -> float | None:
        scores = _of_tasks(run).get(task)
        return number(scores.get(key)) if isinstance(scores, Mapping) else None

    return value


def _tasks(runs: Sequence[RunResults]) -> list[str]:
    """Return the tasks in whose regions the maps were scored, by the name of the agent."""
    return list(dict.fromkeys(task for run in runs for task in _of_tasks(run)))


def _values(runs: Sequence[RunResults], value: Callable[[RunResults], float | None]) -> dict[str, float | None]:
    return {run.name: value(run) for run in runs}


def _score_section(runs: Sequence[RunResults]) -> Iterator[Element]:
    table = figures_table(runs, (*_task_figures(runs), *SCORES))
    if table is None:
        hint = "The maps were not scored on held-out views: see gausslite eval --save-scores."
        yield _section("Quality", styled("p", "muted", hint))
        return
    scored = [run for run in runs if run.scores]
    notes = ["Means over the views that were scored."]
    trained = [run.name for run in scored if not _is_held_out(run)]
    if trained:
        notes.append(f"Views that also trained the map may be among them for {', '.join(trained)}.")
    else:
        notes.append("They were held out: no map was trained on them.")
    if len({run.scores.get("n_views") for run in scored}) > 1:
        notes.append("The runs were scored on different numbers of views: their figures are not comparable.")
    purposes = [element("li", f"{run.name}: {MAP_PURPOSES[run.name]}") for run in runs if run.name in MAP_PURPOSES]
    lists = [styled("ul", "muted", *purposes)] if purposes else []
    yield _section("Quality", styled("p", "muted", " ".join(notes)), table, *lists)


def _is_held_out(run: RunResults) -> bool:
    """True if the scored views are those that the run held out. Those of a demo always are; other frames may not be."""
    scores = run.scores
    if "test_every" not in scores:
        return True
    return scores["test_every"] is not None and scores["test_every"] == run.report.get("hold_out")


def _bars(runs: Sequence[RunResults], colours: dict[str, str]) -> Iterator[Element]:
    if len(runs) < 2:
        return
    for title, figure in _BARS:
        values = {run.name: (colours[run.name], value) for run in runs if (value := figure.value(run)) is not None}
        if len(values) > 1:
            yield bar_chart(title, values, figure.text)


def _lines(runs: Sequence[RunResults], colours: dict[str, str]) -> Iterator[Element]:
    recorded = [run for run in runs if len(run.timeline.get("frame", ())) > 1]
    for title, column, text in _LINES:
        lines = {run.name: Line(colours[run.name], run.timeline["frame"], run.timeline[column]) for run in recorded}
        if any(line.y.any() for line in lines.values()):
            yield line_chart(title, lines, text)


def _view_note(runs: Sequence[RunResults]) -> Element:
    notes = [
        "Keyframes that trained a map: these figures do not show its quality from other viewpoints. All runs are "
        "rendered at the same views."
    ]
    if any(run.report.get("camera_correction") for run in runs):
        notes.append("The camera's motion during a frame is not rendered, so moving views have lower figures here.")
    return styled("p", "muted", " ".join(notes))


def _kappa_legends(runs: Sequence[RunResults]) -> list[Element]:
    return [
        styled("div", "legend", f"kappa of {run.name}: ", colour_legend(run.contents, ColourMode.KAPPA)) for run in runs
    ]


def _plan_notes() -> list[Element]:
    text = (
        "Each map without its ceiling, with the camera's path and the boxes of the task's objects; below in the "
        "colours of kappa."
    )
    return [styled("p", "muted", text)]


def _plans(runs: Sequence[RunResults]) -> Element:
    plan = PlanCamera.above([run.contents for run in runs])
    if plan is None:
        return styled("p", "muted", "The maps are empty.")
    cells = [plan_view(run.contents, run.contents.gaussians, plan, run.name) for run in runs]
    cells += [_coloured_plan(run, plan, ColourMode.KAPPA) for run in runs]
    grid = element("div", *cells, attributes={"class": "grid", "style": f"--columns:{len(runs)}"})
    return element("div", *(_shares(run, plan) for run in runs if len(run.contents.agents) > 1), grid)


def _coloured_plan(run: RunResults, plan: PlanCamera, mode: ColourMode) -> Element:
    return plan_view(run.contents, coloured_gaussians(run.contents, mode), plan, f"{run.name}: {mode}")


def _shares(run: RunResults, plan: PlanCamera) -> Element:
    """Return which robot each part of a team's map came from: what the other robots lack alone."""
    counts = np.bincount(run.contents.agent[run.contents.agent >= 0], minlength=len(run.contents.agents))
    total = len(run.contents.gaussians)
    shares = [
        f"{as_percent(count / total)} from {name}" for name, count in zip(run.contents.agents, counts, strict=True)
    ]
    text = f"What no robot has alone: of {run.name}, {', '.join(shares)}."
    picture = _coloured_plan(run, plan, ColourMode.AGENT)
    legend = colour_legend(run.contents, ColourMode.AGENT)
    return styled("div", "shares", styled("p", "muted", text), legend, picture)


def _by_world_frame(runs: Sequence[RunResults]) -> list[list[RunResults]]:
    """Return the runs in groups of one world frame; a run that names none is a group of its own."""
    groups: dict[tuple[str, str], list[RunResults]] = {}
    for run in runs:
        groups.setdefault((run.world_frame, "" if run.world_frame else run.name), []).append(run)
    return list(groups.values())


def _folded(sections: Sequence[Element], name: str, count: int | None = None) -> list[Element]:
    """Return sections that a click opens. count: of what they hold, if that is not one each."""
    if not sections:
        return []
    return [element("details", element("summary", f"{count or len(sections)} more {name}"), *sections)]


def _as_thumbnail(sheet: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "_ _ 3"]:
    """Return a comparison sheet at no more than the width at which the page shows it."""
    import cv2

    height, width = sheet.shape[:2]
    scale = min(1.0, _SHEET_WIDTH_PX / width)
    size = (round(scale * width), max(1, round(scale * height)))
    return np.asarray(cv2.resize(sheet, size, interpolation=cv2.INTER_AREA), np.uint8)


def _section(title: str, *children: Element) -> Element:
    return element("section", element("h2", title), *children)


def _present(*elements: Element | None) -> list[Element]:
    return [item for item in elements if item is not None]


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)
