"""Run a detector once per frame for the nouns of all tasks: with tiles, 200 tasks would run it 1000 times."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import Detection
from gausslite.perception.detector import Detector


class SharedDetections:
    """A Detector that detects all nouns at once, and keeps the result for the latest frame.

    Detectors treat each noun alone, so every task gets the detections that it would get without the others.
    """

    def __init__(self, detector: Detector, nouns: Sequence[str]) -> None:
        self._detector = detector
        self._nouns = tuple(nouns)
        self._latest: tuple[Frame, list[Detection]] | None = None

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what the detector searches for each query."""
        return self._detector.matches(queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the detections of these nouns, best first. queries: some of the nouns."""
        if self._latest is None or self._latest[0] is not frame:
            self._latest = frame, self._detector.detect(frame, self._nouns)
        return [detection for detection in self._latest[1] if detection.phrase in queries]
