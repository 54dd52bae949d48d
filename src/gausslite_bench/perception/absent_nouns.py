"""Choose nouns of objects that a scene does not show, and count how often a search for one marks pixels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import NounMatch
from gausslite.domain.task import TaskGraph
from gausslite.nouns import is_generic, is_structure, normalised_noun, same_kind
from gausslite_bench.perception.stage_scores import PerceptionStage, TaskQuery, TaskScore

_MAX_MARKED_SHARE = 0.005


@dataclass(frozen=True, slots=True)
class AbsentSummary:
    """Searches for absent nouns: how many, how many the detector has a class for, and how many mark pixels.

    marked: tasks that mark a pixel in any frame. over_limit: tasks that mark more than 0.5 % of all pixels.
    """

    nouns: int
    searched: int
    marked: int
    over_limit: int

    @classmethod
    def from_scores(cls, scores: Sequence[TaskScore], matches: Sequence[NounMatch]) -> AbsentSummary:
        """Count the scores of tasks without objects, at the stage `completed`."""
        shares = [score.stages[PerceptionStage.COMPLETED].marked_mean for score in scores if not score.objects]
        return cls(
            nouns=len(shares),
            searched=sum(match.is_searched for match in matches),
            marked=sum(share > 0 for share in shares),
            over_limit=sum(share > _MAX_MARKED_SHARE for share in shares),
        )

    def describe(self) -> str:
        """Return one sentence."""
        return (
            f"{self.nouns} absent nouns, {self.searched} of them searched as a class: {self.marked} mark a pixel, "
            f"{self.over_limit} mark more than {100 * _MAX_MARKED_SHARE:g} % of all pixels."
        )


def choose_absent_nouns(
    classes: Sequence[str], vocabulary: Collection[str], present: Collection[str], count: int
) -> list[str]:
    """Return `count` nouns of no present object: the detector's classes, then nouns at equal steps of the vocabulary.

    present: names of objects in the scene; a noun of the same kind, or that contains one, is left out. Raises
    InvalidInputError if there are fewer nouns.
    """
    absent_classes = [name for name in classes if _is_absent(name, present)][:count]
    known = {normalised_noun(name) for name in classes}
    others = sorted(noun for noun in vocabulary if noun not in known and _is_absent(noun, present))
    needed = count - len(absent_classes)
    if needed > len(others):
        raise InvalidInputError(f"--absent: expected at most {len(absent_classes) + len(others)} nouns, got {count}")
    rows = np.arange(needed) * len(others) // max(1, needed)
    return absent_classes + [others[row] for row in rows]


def absent_queries(nouns: Sequence[str]) -> list[TaskQuery]:
    """Return a search for each noun, without objects."""
    return [TaskQuery(TaskGraph(noun, f"Find the {noun}", (noun,), (), ()), ()) for noun in nouns]


def _is_absent(noun: str, present: Collection[str]) -> bool:
    words = set(normalised_noun(noun).split())
    is_present = any(same_kind(noun, name) or normalised_noun(name) in words for name in present)
    return not (is_present or is_generic(noun) or is_structure(noun))
