"""A mapping run between two processes: saved whole, and taken up again where it ended, on the terms it was begun on."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.state import State, add_prefix, encode_text, get_array, get_text, int_array, select_prefix
from gausslite.errors import GaussLiteError, MapFileError, MismatchError
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import TaskMapper

_LONGEST_SHOWN = 200


@dataclass(frozen=True, slots=True)
class ResumeConfig:
    """What must be the same when a run goes on: options of the command line, as texts."""

    options: Mapping[str, str]

    @classmethod
    def of(cls, settings: MissionSettings, **beside: str) -> ResumeConfig:
        """How the robot maps, and what else the caller holds to; threads and backend are free to change."""
        options = {
            "policy": settings.policy,
            "without": ",".join(sorted(settings.disabled)),
            "max_gaussians": str(settings.max_gaussians),
            "iterations": _or_default(settings.iterations),
            "rate": _or_default(settings.rate_hz),
            "least": str(settings.min_iterations),
            "relief": ",".join(settings.skip_stages),
            "deadline_slack": str(settings.deadline_slack),
            "seed": str(settings.seed),
            "view_error": str(settings.pose_prior),
        }
        return cls({**options, **beside})

    def differences(self, wanted: ResumeConfig) -> tuple[str, ...]:
        """One text for each option that is not as wanted."""
        names = sorted(self.options.keys() | wanted.options.keys())
        pairs = ((name, self.options.get(name, ""), wanted.options.get(name, "")) for name in names)
        return tuple(
            f"--{name.replace('_', '-')} {right[:_LONGEST_SHOWN]!r} (got {came[:_LONGEST_SHOWN]!r})"
            for name, came, right in pairs
            if came != right
        )


@dataclass(frozen=True, slots=True, eq=False)
class SavedRun:
    """A run as it lies in a file; beside is what the one who saved it added."""

    path: Path
    terms: ResumeConfig
    last_index: int
    beside: State
    _loop: State = field(repr=False)

    @classmethod
    def read(cls, path: Path) -> SavedRun:
        """Raises MapFileError for a file that is none."""
        saved = read_state(path)
        with _in_file(path):
            about = select_prefix(saved, "about")
            [last_index] = get_array(about, "last_index", (1,), np.int64)
            terms = ResumeConfig(_texts(get_text(about, "terms")))
            return cls(path, terms, int(last_index), select_prefix(saved, "beside"), select_prefix(saved, "loop"))

    def require(self, terms: ResumeConfig) -> None:
        """Raise MismatchError naming the options that are not those of the saved run."""
        differences = terms.differences(self.terms)
        if differences:
            raise MismatchError(f"{self.path}: expected the options of the saved run, {', '.join(differences)}")

    def restore(self, loop: TaskMapper) -> None:
        """Put a fresh loop where the saved one stood.

        On the same terms the frames after the last one give the same bits as without the interruption, as far as
        iterations are counted. Raises MapFileError; after it the loop must not be used.
        """
        with _in_file(self.path):
            loop.restore(self._loop)


def save_run(path: Path, loop: TaskMapper, terms: ResumeConfig, last_index: int, beside: State | None = None) -> None:
    """Save a run whose last frame had this number. Raises StorageError."""
    about: State = {"terms": encode_text(json.dumps(dict(terms.options))), "last_index": int_array(last_index)}
    write_state(
        path, {**add_prefix("about", about), **add_prefix("loop", loop.state()), **add_prefix("beside", beside or {})}
    )


@contextmanager
def _in_file(path: Path) -> Iterator[None]:
    """Whatever is wrong in there is wrong with this file."""
    try:
        yield
    except GaussLiteError as error:
        raise MapFileError(f"{path}: {error}") from error


def _texts(stored: str) -> dict[str, str]:
    try:
        texts = json.loads(stored)
    except (ValueError, RecursionError):
        texts = None
    if not isinstance(texts, dict) or not all(isinstance(value, str) for value in texts.values()):
        raise MapFileError("state terms: expected options as texts, got others")
    return texts


def _or_default(value: float | None) -> str:
    return "default" if value is None else f"{value:g}"
