"""The selector of a task: colours, heights of surfaces, superlatives, and relations beyond near and on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.state import State, get_array
from gausslite.domain.task import Relation, TaskGraph, noun_of
from gausslite.perception.object_map import Landmark, Measured, Observation
from gausslite.perception.selector import Fit, Selector, TaskObjects
from gausslite_selection import relations as spatial
from gausslite_selection.colours import ColourFilter, mask_colours, no_colours
from gausslite_selection.left_out import left_out_note
from gausslite_selection.superlatives import select_extreme
from gausslite_selection.supporting_surface import FloorLevel, SupportingSurfaces, level_under_m, nouns_known_by_height

_MAX_LEVELS = 50
"""Levels of planes under an object, of which the median counts."""


@dataclass(frozen=True, slots=True, eq=False)
class Attributes:
    """What masks of an object have shown.

    colours: sums of `colour_counts`. levels_m: the latest levels of planes seen under it, along up in the world.
    """

    colours: Float64[ndarray, "balances ranges"] = field(default_factory=no_colours)
    levels_m: Float64[ndarray, " s"] = field(default_factory=lambda: np.zeros(0))

    def add(self, other: Attributes) -> Attributes:
        """Return the attributes over the observations of both."""
        levels_m = np.concatenate([self.levels_m, other.levels_m])[-_MAX_LEVELS:]
        return Attributes(self.colours + other.colours, levels_m)

    def state(self) -> State:
        """Return the attributes as named arrays."""
        return {"colours": self.colours, "supports_m": self.levels_m}


def attributes_of(measured: Measured | None) -> Attributes:
    """Return what was measured of an object, or nothing."""
    return measured if isinstance(measured, Attributes) else Attributes()


class AttributeSelector(Selector):
    """The Selector that this package registers."""

    def __init__(self, graph: TaskGraph, matches: Sequence[NounMatch], up: Float64[ndarray, "3"]) -> None:
        super().__init__(graph, matches, up)
        self._graph, self._up = graph, up
        self._colours = ColourFilter(graph)
        self._surfaces = SupportingSurfaces(graph, nouns_known_by_height(matches), up)
        self._superlatives = {attributes.name: attributes.superlative for attributes in graph.attributes}
        self._camera_m: Float64[ndarray, "3"] | None = None  # the latest, which sides are relative to

    def observe(self, frame: Frame) -> None:
        """Count the points of a frame by their height."""
        self._camera_m = frame.T_world_camera[:3, 3]
        self._surfaces.observe(frame)

    def measured(self, observation: Observation, mask: Bool[ndarray, "h w"], frame: Frame) -> Attributes:
        """Return the colours of a mask, unless it is of a weak detection, and the level of the plane under it."""
        colours = no_colours() if observation.is_weak else mask_colours(mask, frame)
        level_m = level_under_m(mask, frame, self._up) if self._surfaces.are_needed else np.nan
        return Attributes(colours, np.array([level_m] if np.isfinite(level_m) else []))

    def fit(self, name: str, measured: Measured | None) -> Fit:
        """Return whether an object has the colour of a name."""
        return self._colours.match(name, attributes_of(measured).colours)

    def is_excluded(self, noun: str, measured: Measured | None) -> bool:
        """Return True if an object of a target's noun surely has the colour of an excluded object of this noun."""
        return self._colours.is_excluded(noun, attributes_of(measured).colours)

    def decides(self, relation: Relation) -> bool:
        """Return True if heights decide a relation."""
        return self._surfaces.is_by_height(relation)

    def holds(self, relations: Sequence[Relation], observation: Observation, objects: TaskObjects) -> bool | None:
        """Return whether a condition holds, by heights or by the positions of objects; None if it is not evaluated."""
        by_height = self._stands_on(relations[0], observation)
        return spatial.holds(relations, observation, objects, self._up) if by_height is None else by_height

    def select(self, target: str, landmarks: list[Landmark], T_world_camera: Float64[ndarray, "4 4"]) -> list[Landmark]:
        """Return the landmark that the target's superlative selects; all without one."""
        superlative = self._superlatives.get(target)
        if superlative is None or not landmarks:
            return landmarks
        return [select_extreme(landmarks, superlative, self._up, T_world_camera)]

    def label(self, name: str) -> str:
        """Return the noun of a name with its colour."""
        return self._colours.label(name)

    def notes(self, confirmed: Sequence[Landmark], objects: TaskObjects) -> tuple[str, ...]:
        """Return what colours and heights decided, and the relations that leave out every object of a target."""
        seen = [(landmark.phrase, attributes_of(landmark.measured).colours) for landmark in confirmed]
        left_out = filter(None, (self._left_out(target, confirmed, objects) for target in self._graph.targets))
        return (*self._colours.notes(seen), *self._height_notes(confirmed, objects), *left_out)

    def state(self) -> State:
        """Return the counts of points by their height."""
        return self._surfaces.floor.state()

    def restore(self, state: State) -> None:
        """Replace the counts of points by their height. Raises MapFileError."""
        self._surfaces.floor = FloorLevel.decode(state)

    def decode(self, state: State) -> Attributes:
        """Return one object's attributes. Raises MapFileError."""
        colours = get_array(state, "colours", no_colours().shape, np.float64).copy()
        if not np.isfinite(colours).all() or (colours < 0).any():
            raise MapFileError("state landmark: expected colours of zero or more, got others")
        levels_m = get_array(state, "supports_m", (None,), np.float64).copy()
        if len(levels_m) > _MAX_LEVELS or not np.isfinite(levels_m).all():
            raise MapFileError(f"state landmark: expected at most {_MAX_LEVELS} finite levels, got {len(levels_m)}")
        return Attributes(colours, levels_m)

    def _left_out(self, target: str, confirmed: Sequence[Landmark], objects: TaskObjects) -> str | None:
        own = [landmark for landmark in confirmed if landmark.phrase == noun_of(target)]
        if any(landmark.is_given for landmark in own):
            return None
        seen = [
            replace(landmark.seen_from(landmark.centroid_m), camera_m=self._camera_m)
            for landmark in own
            if self.fit(target, landmark.measured) is not Fit.NO
            and not self.is_excluded(landmark.phrase, landmark.measured)
        ]
        return left_out_note(self._graph, target, seen, self, objects)

    def _stands_on(self, relation: Relation, seen: Landmark | Observation) -> bool | None:
        return self._surfaces.stands_on(relation, seen.votes, attributes_of(seen.measured).levels_m)

    def _height_notes(self, confirmed: Sequence[Landmark], objects: TaskObjects) -> list[str]:
        """Return which relations heights decide, for how many of the objects, and what happens to the others."""
        relations = {
            (relation.target, relation.anchor): relation for relation in self._graph.relations if self.decides(relation)
        }
        notes = []
        for relation in relations.values():
            noun, anchor = noun_of(relation.target), noun_of(relation.anchor)
            seen = [landmark for landmark in confirmed if landmark.phrase == noun]
            sure = sum(self._stands_on(relation, landmark) is not None for landmark in seen)
            others = "compared with the class detected instead" if objects.seen(relation.anchor) else "kept"
            others = "left out" if others == "kept" and relation.negated else others
            notes.append(
                f"no class of the detector is a {anchor!r}: the height of what an object stands on decides, so far "
                f"for {sure} of {len(seen)} {noun!r} objects; the others are {others}"
            )
        return notes
