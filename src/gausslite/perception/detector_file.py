"""Open the user's detector file with the installed reader that knows its kind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from gausslite.domain.errors import ModelFileError
from gausslite.perception.detector import Detector
from gausslite.plugins import DEFAULT, Group, installed, load

MAX_TILES_PER_SIDE: Final = 4


@dataclass(frozen=True, slots=True)
class DetectorOptions:
    """What the user states beside the file; a reader ignores what its kind of file does not have."""

    segmenter: str | None = None
    """How boxes become masks: "yolo" (the file's own masks), "depth", or the path of a second file; None: the reader
    chooses."""
    vocabulary: Path | None = None
    """The vocabulary of the file's text encoder; None: beside the file."""
    threads: int | None = None
    """None: as many as the runtime chooses."""
    accept_similar: bool = False
    """Also detect classes that are only similar to a noun."""
    min_score: float | None = None
    """From which a detection counts; None: the reader's own."""
    tiles_per_side: int = 1
    """Also detect in this many times as many enlarged parts of the image; 1: in the whole image alone."""
    time_limit_s: float | None = None
    """No further part is started if it would end later than this after the detection began; None: all parts."""


class DetectorReader(Protocol):
    """Opens files of one kind; a package registers it in the group `gausslite.detectors`."""

    def open(self, path: Path, options: DetectorOptions, /) -> Detector | None:
        """Return the detector of a file; None if the file is not of this kind.

        Raises ModelFileError if it is of this kind and damaged, InvalidInputError if the options do not fit it.
        """

    def advice(self) -> str:
        """Return how a user without a file gets one, in one line."""


def open_detector(path: Path, options: DetectorOptions) -> Detector:
    """Return the detector of the first reader that knows the file; the default reader is asked last.

    Raises ModelFileError, InvalidInputError, KernelError, and MissingPluginError without the default reader.
    """
    for name, reader in installed(Group.DETECTORS):
        detector: Detector | None = None if name == DEFAULT else reader.open(path, options)
        if detector is not None:
            return detector
    detector = load(Group.DETECTORS, purpose="--detector").open(path, options)
    if detector is None:
        raise ModelFileError(f"model {path}: expected a file that an installed reader of detectors knows")
    return detector


def detector_advice() -> str:
    """Return how a user gets a file, of each reader. Raises MissingPluginError if no reader is installed."""
    advice = "; or ".join(reader.advice() for _, reader in installed(Group.DETECTORS))
    return advice or str(load(Group.DETECTORS, purpose="--detector").advice())
