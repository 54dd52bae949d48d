"""Assemble the page: one self-contained HTML file without scripts and without requests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from xml.etree.ElementTree import Element

from gausslite.codec.state_file import read_png, write_atomic
from gausslite.domain.errors import StorageError
from gausslite_view.report_elements import as_html, element, picture, styled
from gausslite_view.report_parts import (
    MAP_SIZE,
    SCORES,
    TIMES,
    ReportContents,
    RunResults,
    as_count,
    as_percent,
    as_seconds,
    figures_table,
    nouns_table,
    objects_table,
    read_results,
    settings_table,
    task_column,
)
from gausslite_view.report_pictures import (
    Line,
    PlanCamera,
    bar_chart,
    kappa_gaussians,
    kappa_legend,
    line_chart,
    plan_view,
    run_colour,
    run_legend,
    shared_views,
    view_sections,
)

_GENERATOR = "gausslite report"
# the browser itself refuses every request and every script
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_HEAD_BYTES = 512
_OPEN_VIEWS = 2
_BARS = (("region PSNR", SCORES[0]), ("image PSNR", SCORES[2]), ("Gaussians", MAP_SIZE[0]), ("frame rate", TIMES[4]))
_LINES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("time of each frame", "seconds", as_seconds),
    ("Gaussians after each frame", "gaussians", as_count),
    ("region's share of the pixels", "roi_share", as_percent),
    ("training iterations of each frame", "iterations", as_count),
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
    runs = contents.runs
    colours = {run.name: run_colour(i) for i, run in enumerate(runs)}
    yield _section("Task", styled("div", "cards", *(task_column(run) for run in runs if run.report)))
    yield from _score_section(runs)
    tables = _present(figures_table(runs, MAP_SIZE), figures_table(runs, TIMES))
    yield _section("Map and time", styled("div", "tables", *tables))
    if charts := [*_bars(runs, colours), *_lines(runs, colours)]:
        yield _section("Plots", run_legend(colours), styled("div", "charts", *charts))
    for group in _by_world_frame(runs):
        if views := shared_views(group):
            sections = view_sections(group, views)
            yield _section("Views", *_view_notes(group), *sections[:_OPEN_VIEWS], *_folded(sections[_OPEN_VIEWS:]))
    if contents.sheets:
        sheets = [picture(read_png(path), caption) for path, caption in contents.sheets.items()]
        yield _section("Pictures", styled("div", "sheets", *sheets))
    if plans := [_plans(group) for group in _by_world_frame(runs)]:
        yield _section("From above", *_plan_notes(), *plans)
    if tables := _present(objects_table(runs), nouns_table(runs)):
        yield _section("Objects", *tables)
    yield _section("Settings", *_present(settings_table(runs)))


def _score_section(runs: Sequence[RunResults]) -> Iterator[Element]:
    table = figures_table(runs, SCORES)
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
    yield _section("Quality", styled("p", "muted", " ".join(notes)), table)


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


def _view_notes(runs: Sequence[RunResults]) -> list[Element]:
    notes = [
        "Keyframes that trained a map: these figures do not show its quality from other viewpoints. All runs are "
        "rendered at the same views."
    ]
    if any(run.report.get("camera_correction") for run in runs):
        notes.append("The camera's motion during a frame is not rendered, so moving views have lower figures here.")
    legends = [styled("div", "legend", f"kappa of {run.name}: ", kappa_legend(run.contents)) for run in runs]
    return [styled("p", "muted", " ".join(notes)), *legends]


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
    cells += [plan_view(run.contents, kappa_gaussians(run.contents), plan, f"{run.name}: kappa") for run in runs]
    return element("div", *cells, attributes={"class": "grid", "style": f"--columns:{len(runs)}"})


def _by_world_frame(runs: Sequence[RunResults]) -> list[list[RunResults]]:
    """Return the runs in groups of one world frame; a run that names none is a group of its own."""
    groups: dict[tuple[str, str], list[RunResults]] = {}
    for run in runs:
        groups.setdefault((run.world_frame, "" if run.world_frame else run.name), []).append(run)
    return list(groups.values())


def _folded(sections: Sequence[Element]) -> list[Element]:
    if not sections:
        return []
    return [element("details", element("summary", f"{len(sections)} more views"), *sections)]


def _section(title: str, *children: Element) -> Element:
    return element("section", element("h2", title), *children)


def _present(*elements: Element | None) -> list[Element]:
    return [item for item in elements if item is not None]


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)
