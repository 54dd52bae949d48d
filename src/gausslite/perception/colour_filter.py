"""Decide by their measured colours which objects a task's names can mean, and describe the decision."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.colours import ColourMatch, is_evaluated, match_colour
from gausslite.perception.object_map import Landmark, Observation


class ColourFilter:
    """The colours of a task's names. An object whose colour clearly differs is not meant; a doubtful one is."""

    def __init__(self, graph: TaskGraph) -> None:
        self._colours = {each.name: each.colour for each in graph.attributes if each.colour is not None}
        named = {noun_of(target) for target in graph.targets}
        self._excluded = tuple(
            (noun_of(name), self._colours[name])
            for name in graph.excluded
            if name in self._colours and noun_of(name) in named
        )
        self._names = tuple(name for name in self._colours if name not in graph.excluded)
        self._excluded_everywhere = tuple(
            name for name in graph.excluded if name in self._colours and noun_of(name) not in named
        )

    def match(self, name: str, seen: Landmark | Observation) -> ColourMatch:
        """Return whether an object has the colour of a name; YES for a name without a colour."""
        colour = self._colours.get(name)
        return ColourMatch.YES if colour is None else match_colour(colour, seen.colours)

    def allows(self, name: str, seen: Landmark | Observation) -> bool:
        """Return False if the colour of an object clearly differs from that of a name."""
        return self.match(name, seen) is not ColourMatch.NO

    def is_excluded(self, seen: Landmark | Observation) -> bool:
        """Return True if an object of a target's noun clearly has the colour of an excluded object of this noun."""
        return any(
            noun == seen.phrase and match_colour(colour, seen.colours) is ColourMatch.YES
            for noun, colour in self._excluded
        )

    def label(self, name: str) -> str:
        """Return the noun of a name with its colour."""
        return " ".join(filter(None, (self._colours.get(name), noun_of(name))))

    def notes(self, landmarks: Sequence[Landmark]) -> tuple[str, ...]:
        """Return one line for each colour that could not decide about all of these objects, or that left some out."""
        lines = [self._describe(name, landmarks) for name in self._names]
        for noun, colour in self._excluded:
            matches = [match_colour(colour, each.colours) for each in landmarks if each.phrase == noun]
            doubtful = matches.count(ColourMatch.DOUBTFUL)
            if doubtful:
                lines.append(f"excluded {colour} {noun!r}: {doubtful} of {len(matches)} objects may be one, and count")
        lines += [
            f"excluded {self.label(name)!r}: its colour is not evaluated, every {noun_of(name)!r} is left out"
            for name in self._excluded_everywhere
        ]
        return tuple(line for line in lines if line)

    def _describe(self, name: str, landmarks: Sequence[Landmark]) -> str:
        colour, noun = self._colours[name], noun_of(name)
        if not is_evaluated(colour):
            return f"{colour} {noun!r}: this colour is not evaluated, every {noun!r} counts"
        matches = [self.match(name, each) for each in landmarks if each.phrase == noun]
        other, doubtful = matches.count(ColourMatch.NO), matches.count(ColourMatch.DOUBTFUL)
        parts = []
        if other:
            parts.append(f"{other} of {len(matches)} objects of another colour do not count")
        if doubtful:
            parts.append(f"{doubtful} of {len(matches)} objects of doubtful colour count")
        return f"{colour} {noun!r}: {', '.join(parts)}" if parts else ""
