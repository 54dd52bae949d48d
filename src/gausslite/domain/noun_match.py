"""What a detector searches for a task's noun: which of its classes, how similar, and what it has detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class MatchBasis(StrEnum):
    """Why a noun is searched as these classes. SIMILAR classes are different things; NONE: there is no class."""

    NAME = "name"
    SYNONYM = "synonym"
    TEXT_FEATURES = "text features"
    GENERIC = "generic noun"
    PHRASE = "any phrase"
    REGION = "ground truth"
    SIMILAR = "similar class"
    NONE = "no class"


@dataclass(frozen=True, slots=True)
class NounMatch:
    """The classes that a detector searches for one noun of a task.

    similarity: cosine of the noun's and the class's centred text features, None without a comparison. accepted: False
    if the class is a different thing and only reported; then `classes` has its name, and nothing is searched. known:
    the ground truth's regions, for a message.
    """

    noun: str
    basis: MatchBasis
    classes: tuple[str, ...] = ()
    similarity: float | None = None
    accepted: bool = True
    known: tuple[str, ...] = ()

    @property
    def is_searched(self) -> bool:
        """Return True if the detector can find the noun."""
        return self.accepted and (bool(self.classes) or self.basis is MatchBasis.PHRASE)

    @property
    def warning(self) -> str | None:
        """Return why the noun cannot be found or may be a different thing; None if it is searched as itself."""
        if self.basis is MatchBasis.NONE:
            return f"no class of the detector matches {self.noun!r}"
        if self.basis is MatchBasis.REGION and not self.classes:
            return f"no region matches {self.noun!r}; the regions are {', '.join(self.known) or 'none'}"
        if self.basis is not MatchBasis.SIMILAR:
            return None
        similar = f"the class most similar to {self.noun!r} is {self.classes[0]!r} (similarity {self.similarity:.2f})"
        if self.accepted:
            return f"{similar}: it counts as {self.noun!r}, because similar classes are accepted"
        return f"{similar}, a different thing: nothing is searched; accept-similar = true accepts it"

    def describe(self) -> str:
        """Return one line for the operator."""
        if self.warning is not None:
            return self.warning
        if self.basis is MatchBasis.GENERIC:
            return f"{self.noun!r} matches {len(self.classes)} classes of the detector ({self.basis})"
        if self.basis is MatchBasis.PHRASE:
            return f"{self.noun!r} is searched as a phrase"
        similarity = "" if self.similarity is None else f", similarity {self.similarity:.2f}"
        return f"{self.noun!r} is searched as {', '.join(map(repr, self.classes))} ({self.basis}{similarity})"


@dataclass(frozen=True, slots=True)
class NounReport:
    """A noun's match, and what has been detected of it so far.

    detections: number of detections in all frames. best_score: the highest score, 0 without a detection. objects: the
    number of confirmed objects. rival: the class that detections of this noun rather show, None without one.
    """

    match: NounMatch
    detections: int = 0
    best_score: float = 0.0
    objects: int = 0
    rival: str | None = None

    def describe(self) -> str:
        """Return one line for the operator."""
        found = f"{self.detections} detections, best score {self.best_score:.2f}, {self.objects} confirmed"
        return f"{self.match.describe()}: {found}" if self.match.is_searched else self.match.describe()


def match_warnings(matches: Sequence[NounMatch]) -> tuple[str, ...]:
    """Return one message for each noun that cannot be found or may be a different thing."""
    return tuple(match.warning for match in matches if match.warning is not None)
