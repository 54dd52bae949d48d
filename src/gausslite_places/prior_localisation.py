"""Localise the sequence of `gausslite map --prior` in the saved map, and move it to the map's frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

from gausslite.cli.map_inputs import MapInputs
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.mission.settings import PoseMode
from gausslite.process import print_message
from gausslite_places.moved_source import MovedSource
from gausslite_places.prior_map import MAX_LOCALISED_FRAMES, SavedMap
from gausslite_places.prior_run import PriorRun


def localised(earlier: SavedMap, inputs: MapInputs) -> PriorRun:
    """Localise the sequence in the map of an earlier run, and print the result."""
    prior = PriorRun(earlier, inputs.mission)
    for frame in _frames(inputs):
        if prior.is_done:
            break
        prior.offer(frame)
    print_message(prior.describe())
    return prior


def in_frame_of(prior: PriorRun, inputs: MapInputs) -> MapInputs:
    """Return the inputs with the sequence in the saved map's frame, or as they are if it is not recognised."""
    if prior.motion is None:
        return inputs
    source = MovedSource(inputs.stream.source, prior.motion, prior.saved.world_frame)
    return replace(inputs, stream=replace(inputs.stream, source=source))


def _frames(inputs: MapInputs) -> Iterator[Frame]:
    """Yield frames to localise: spread over the sequence; only its first ones if given poses are not used."""
    positions, count = inputs.stream.positions, MAX_LOCALISED_FRAMES
    step = 1 if inputs.mission.poses is PoseMode.TRACK else max(len(positions) // count, 1)
    for position in positions[::step][:count]:
        with suppress(DatasetError, PoseError):  # a frame that cannot be read is reported where it is mapped
            yield inputs.stream.source.frame(position, inputs.stream.size)
