"""Show what a run was asked and what it found: task graphs, nouns, objects and notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element

from gausslite.domain.objects import ObjectLandmark
from gausslite.report.elements import element, styled
from gausslite.report.figures import list_table, number, short_text
from gausslite.report.run_results import RunResults

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
    rows = [_object_row(run.name, each) for run in runs if run.report for each in run.contents.objects]
    return list_table(_OBJECT_HEADER, rows) if rows else None


def nouns_table(runs: Sequence[RunResults]) -> Element | None:
    """Return what was searched and detected for each noun; None without any."""
    rows = []
    for run in runs:
        nouns = run.report.get("nouns")
        rows += (
            [_noun_row(run.name, each) for each in nouns if isinstance(each, Mapping)]
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
    lines = [_relation(each) for each in relations if isinstance(each, Mapping)] if isinstance(relations, list) else []
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


def _object_row(run: str, landmark: ObjectLandmark) -> list[str]:
    box = landmark.extent_m
    sizes = (high - low for low, high in zip(box.min_m, box.max_m, strict=True))
    centre = "  ".join(f"{value:.2f}" for value in landmark.centroid_m)
    size = " × ".join(f"{value:.2f}" for value in sizes)
    return [run, landmark.object_id, str(landmark.role), centre, size, f"{landmark.confidence:.2f}"]


def _noun_row(run: str, noun: Mapping[str, object]) -> list[str]:
    score = number(noun.get("best_score"))
    found = [short_text(noun.get(key)) or "0" for key in ("detections", "confirmed_objects")]
    searched = short_text(noun.get("classes")) if noun.get("searched") else "not searched"
    best = "–" if score is None else f"{score:.2f}"
    return [run, short_text(noun.get("noun")), searched, short_text(noun.get("basis")), found[0], best, found[1]]
