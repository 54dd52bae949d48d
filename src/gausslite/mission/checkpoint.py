"""Save a mapping run to a file and resume it in another process with the same settings."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from gausslite.codec.state_file import read_state, write_state
from gausslite.config.option import option_key
from gausslite.domain.errors import GaussLiteError, MapFileError, MismatchError
from gausslite.domain.state import State, add_prefix, encode_text, get_array, get_text, int_array, select_prefix
from gausslite.mission.serialisation import field_from_plain, to_plain
from gausslite.mission.task_mapper import TaskMapper

_MAX_SHOWN = 200
_UNSET = "unset"
_NOTHING: tuple[Any, ...] = (None, [], False)


@dataclass(frozen=True, slots=True)
class ResumeConfig:
    """The settings that must be equal when a run is resumed: fields of each settings class as JSON values."""

    sections: Mapping[str, Mapping[str, Any]]

    @classmethod
    def of(cls, *settings: Any) -> ResumeConfig:
        """Return the fields of these settings objects, except those that may change."""
        return cls({type(setting).__name__: _fixed_fields(setting) for setting in settings})

    @classmethod
    def parse(cls, stored: str) -> ResumeConfig:
        """Return the config of a JSON text. Raises MapFileError."""
        try:
            sections = json.loads(stored)
        except (ValueError, RecursionError):
            sections = None
        if not isinstance(sections, dict) or not all(isinstance(section, dict) for section in sections.values()):
            raise MapFileError("state config: expected settings as JSON objects, got something else")
        return cls(sections)

    def value(self, kind: type, name: str) -> Any:
        """Return one field of a settings class. Raises MapFileError if it is missing or has another type."""
        section = self.sections.get(kind.__name__, {})
        if name not in section:
            raise MapFileError(f"state config: expected {kind.__name__}.{name}, got none")
        try:
            return field_from_plain(kind, name, section[name])
        except GaussLiteError as error:
            raise MapFileError(f"state config: {error}") from error

    def differences(self, *settings: Any) -> tuple[str, ...]:
        """Return one text for each option of these settings that differs, with its key and both values."""
        current = ResumeConfig.of(*settings)
        keys = {
            (type(section).__name__, item.name): option_key(type(section), item.name)
            for section in settings
            for item in fields(section)
        }
        names = {
            (section, name)
            for config in (self, current)
            for section in config.sections
            for name in config.sections[section]
        }
        texts = []
        for section, name in names:
            saved, given = (config.sections.get(section, {}).get(name) for config in (self, current))
            if saved != given and not (saved in _NOTHING and given in _NOTHING):
                key = keys.get((section, name), name.replace("_", "-"))
                texts.append(f"{key} {_show(saved)} (got {_show(given)})")
        return tuple(sorted(texts))


@dataclass(frozen=True, slots=True, eq=False)
class SavedRun:
    """A run read from a file."""

    path: Path
    config: ResumeConfig
    last_index: int
    extra: State  # the arrays that the caller of `save_run` added
    _task_mapper: State = field(repr=False)

    @classmethod
    def read(cls, path: Path) -> SavedRun:
        """Read a saved run. Raises MapFileError if the file is not one."""
        saved = read_state(path)
        with _errors_name(path):
            run = select_prefix(saved, "run")
            [last_index] = get_array(run, "last_index", (1,), np.int64)
            config = ResumeConfig.parse(get_text(run, "config"))
            return cls(path, config, int(last_index), select_prefix(saved, "extra"), select_prefix(saved, "mapper"))

    def require(self, *settings: Any) -> None:
        """Raise MismatchError that names the options that differ from the saved run's."""
        differences = self.config.differences(*settings)
        if differences:
            raise MismatchError(f"{self.path}: expected the options of the saved run, {', '.join(differences)}")

    def value(self, kind: type, name: str) -> Any:
        """Return one field of the saved settings. Raises MapFileError."""
        with _errors_name(self.path):
            return self.config.value(kind, name)

    def restore(self, mapper: TaskMapper) -> None:
        """Bring a new TaskMapper to the saved state.

        With the same settings and counted iterations, the following frames give the same bits as without the
        interruption. Raises MapFileError; the TaskMapper must not be used after it.
        """
        with _errors_name(self.path):
            mapper.restore(self._task_mapper)


def save_run(path: Path, mapper: TaskMapper, config: ResumeConfig, last_index: int, extra: State | None = None) -> None:
    """Save a run whose last frame had this index, for its owner alone. Raises StorageError."""
    run: State = {"config": encode_text(json.dumps(config.sections)), "last_index": int_array(last_index)}
    state = {
        **add_prefix("run", run),
        **add_prefix("mapper", mapper.state()),
        **add_prefix("extra", extra or {}),
    }
    write_state(path, state, 0o600)


@contextmanager
def _errors_name(path: Path) -> Iterator[None]:
    """Raise every error in this block as a MapFileError that names the file."""
    try:
        yield
    except GaussLiteError as error:
        raise MapFileError(f"{path}: {error}") from error


def _fixed_fields(settings: Any) -> dict[str, Any]:
    fixed = {}
    for option in fields(settings):
        value = getattr(settings, option.name)
        if option.metadata.get("may_change"):
            continue
        if option.metadata.get("is_file") and value is not None:
            value = Path(value).name
        fixed[option.name] = to_plain(value)
    return fixed


def _show(value: Any) -> str:
    """Return a JSON value as the user writes it on the command line."""
    return _UNSET if value in _NOTHING else repr(_flatten(value)[:_MAX_SHOWN])


def _flatten(value: Any) -> str:
    if isinstance(value, dict):
        return ",".join(map(_flatten, value.values()))
    if isinstance(value, list):
        return ",".join(map(_flatten, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
