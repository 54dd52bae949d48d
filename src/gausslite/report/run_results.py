"""Read the results folders that the page compares: runs of `map`, of agents, and the folder of a demo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.ply import read_ply, read_world_frame
from gausslite.codec.view_images import ViewImage, read_view_images
from gausslite.domain.errors import MapFileError
from gausslite.mission.results import read_evaluation, read_report
from gausslite.mission.timeline import read_timeline
from gausslite.view.contents import ViewContents
from gausslite.view.run_contents import read_contents

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


def _read_run(folder: Path, name: str, scores: Mapping[str, object] | None = None) -> RunResults:
    report, file = read_report(folder), folder / _MAP
    if not report and (folder / "report.json").exists():
        raise MapFileError(f"{folder}/report.json: expected the report of a run, got something else")
    notes = []
    if scores is None:
        try:
            scores = read_evaluation(folder)
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
    objects = tuple(each for run in runs for each in run.contents.objects)
    for name in _FUSED_MAPS:
        file = folder / f"{name}.ply"
        if file.is_file():
            contents = replace(ViewContents.of_one_agent(read_ply(file)), objects=objects)
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
