"""Find plug-ins: what packages beside the core register as entry points of the groups below.

The core holds the protocol of each group (docs/guides/plugin.md lists them) and no name of a plug-in. The preferred
plug-in of a group is registered under the name "default".
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import EntryPoint, distributions
from typing import Any, Final

from gausslite.domain.errors import InvalidInputError, MissingPluginError

DEFAULT: Final = "default"
_BESIDE_THE_CORE: Final = "gausslite_"


class Group(StrEnum):
    """What a plug-in adds to the core."""

    COMMANDS = "gausslite.commands"  # a `Command`; the name is the sub-command
    SOURCES = "gausslite.sources"  # opens recordings; the name is the prefix of an address, as in "sim:home"
    CAMERAS = "gausslite.cameras"  # reads the camera of another tool's files
    CALIBRATORS = "gausslite.calibrators"  # estimates what a recording does not state
    PARSERS = "gausslite.parsers"  # a `ParserBackend`, which reads a sentence as a task graph
    NOUNS = "gausslite.nouns"  # a `NounVocabulary`
    SELECTORS = "gausslite.selectors"  # a `Selector` class: which objects of a noun a task means
    POINTING = "gausslite.pointing"  # a `Pointing`: the object at a point, in a box or at a click
    QUESTIONS = "gausslite.questions"  # a function: the objects of a map that a question's task graph means
    DETECTORS = "gausslite.detectors"  # opens a model file as a detector
    OBJECT_MEMORIES = "gausslite.object_memories"  # remembers what a detector sees beside a task's objects
    POLICIES = "gausslite.policies"  # a `MapperSettings` of another system, to compare with; the name is of `--policy`
    RASTERIZERS = "gausslite.rasterizers"  # a backend; the name is the value of the option
    POSES = "gausslite.poses"  # refines the poses of views, or tracks the camera; the name is a value of `--poses`
    CORRECTORS = "gausslite.correctors"  # finds loops and corrects keyframes
    LOCALISERS = "gausslite.localisers"  # places a run in an earlier map
    PAGERS = "gausslite.pagers"  # keeps what no camera sees on disk
    MONITORS = "gausslite.monitors"  # judges whether a robot is where its odometry says, and finds a lost one
    ALIGNERS = "gausslite.aligners"  # decides the frames of a team's robots
    TEAM_OBJECTS = "gausslite.team_objects"  # merges the objects that a team's robots report
    MAP_RENDERERS = "gausslite.map_renderers"  # renders the fused map from any pose
    MIGRATIONS = "gausslite.migrations"  # the steps that bring a store of an earlier schema forward
    REFINERS = "gausslite.refiners"  # refines the fused map on keyframes
    KEYFRAME_UPLOADS = "gausslite.keyframe_uploads"  # chooses and sends the keyframes of a robot
    TEAM_MAPS = "gausslite.team_maps"  # inserts what teammates trained into an agent's map
    STORES = "gausslite.stores"  # a durable store of a server; the name is the scheme of its URL
    SERVER_COMMANDS = "gausslite.server_commands"  # a command of the fusion server; called with its arguments
    SERVER_SERVICES = "gausslite.server_services"  # a further service of a fusion server
    AGENT_SERVICES = "gausslite.agent_services"  # a further service of an agent
    METRICS = "gausslite.metrics"  # serves the figures of a fusion server
    RUN_RECORDS = "gausslite.run_records"  # writes a file beside the map of a run
    EVALUATORS = "gausslite.evaluators"  # says how well a finished run fits its images
    EXPORTERS = "gausslite.exporters"  # writes a map for another tool; the name is the format
    PAGES = "gausslite.pages"  # shows a run or a service in the browser


@dataclass(frozen=True, slots=True)
class Command:
    """A sub-command of `gausslite`: its line of help, and the module whose `configure(parser)` adds its options."""

    summary: str
    module: str


def names(group: Group) -> tuple[str, ...]:
    """Return the names that are registered in a group, sorted."""
    return tuple(sorted(_registered(group)))


def default_name(group: Group) -> str:
    """Return the other name of the plug-in that is used unless somebody chooses; "default" if it has none."""
    values = {name: entry.value for name, entry in _registered(group).items()}
    others = sorted(name for name, value in values.items() if name != DEFAULT and value == values.get(DEFAULT))
    return others[0] if others else DEFAULT


def load(group: Group, name: str = DEFAULT, purpose: str = "") -> Any:
    """Import a plug-in. Raises MissingPluginError if it is not registered, or its package is not installed;
    InvalidInputError if its import fails.

    purpose: what the error names in place of the plug-in, such as the option that needs it.
    """
    entry = _registered(group).get(name)
    if entry is None:
        known = ", ".join(names(group)) or "none"
        raise MissingPluginError(f"{purpose or name}: expected a plug-in of {group}; installed are: {known}")
    return _import(entry, purpose)


def find(group: Group, name: str = DEFAULT) -> Any | None:
    """Import a plug-in; None if it is not registered, or its package is not installed."""
    try:
        return load(group, name)
    except MissingPluginError:
        return None


def installed(group: Group) -> Iterator[tuple[str, Any]]:
    """Yield the plug-ins of a group by name; those whose package is not installed are left out."""
    for name in names(group):
        plugin = find(group, name)
        if plugin is not None:
            yield name, plugin


def absent_package(error: ModuleNotFoundError) -> str | None:
    """Return the package beside the core that an import has not found; None for another module."""
    package = (error.name or "").partition(".")[0]
    return package if package.startswith(_BESIDE_THE_CORE) else None


def _registered(group: Group) -> dict[str, EntryPoint]:
    return _entry_points().get(group, {})


@functools.cache
def _entry_points() -> dict[str, dict[str, EntryPoint]]:
    """Return the entry points of all groups; one pass over what is installed takes some 30 ms."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for distribution in distributions():
        for entry in distribution.entry_points:
            # of a distribution that is installed twice, the first one on the path counts
            found.setdefault(entry.group, {}).setdefault(entry.name, entry)
    return found


def _import(entry: EntryPoint, purpose: str) -> Any:
    package = entry.module.partition(".")[0]
    name = purpose or (entry.group if entry.name == DEFAULT else entry.name)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        missing = (error.name or package).partition(".")[0]
        needs = f"the package {package}" if missing == package else f"the package {missing}, for {package}"
        raise MissingPluginError(f"{name}: needs {needs}, which is not installed") from error
    except Exception as error:  # code of others may raise anything
        raise InvalidInputError(f"{name}: the package {package} cannot be loaded: {error!r}") from error
