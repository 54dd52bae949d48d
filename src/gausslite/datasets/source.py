"""The protocols of a sequence of posed RGB-D frames and of its reader, and the choice of its frames."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from gausslite.domain.camera import Camera
from gausslite.domain.checks import require_whole
from gausslite.domain.errors import DatasetError, InvalidInputError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import Trajectory, UpAxis
from gausslite.domain.relevance import Region

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class HeldOutSplit:
    """The last of every `every` positions of a sequence is a test frame. Raises InvalidInputError below 2."""

    every: int = 8

    def __post_init__(self) -> None:
        if self.every < 2:
            raise InvalidInputError(f"test every: expected at least 2 (1 would leave no frame), got {self.every}")

    def holds(self, position: int) -> bool:
        """True if the position (from 0) is a test frame."""
        return position % self.every == self.every - 1

    def split(self, indices: Sequence[Item]) -> tuple[list[Item], list[Item]]:
        """Return the training items and the test items, by their position in the sequence, both in order."""
        train = [item for position, item in enumerate(indices) if not self.holds(position)]
        test = [item for position, item in enumerate(indices) if self.holds(position)]
        return train, test


@runtime_checkable
class Source(Protocol):
    """A sequence with random access. Positions run from 0 to len - 1; `indices` returns the sequence's own numbers.

    A class of sources derives from it: what it does not state has the value of a recording that states nothing.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """Short name for reports."""

    @property
    @abstractmethod
    def camera(self) -> Camera:
        """Camera at the sequence's own resolution (pixel centres at +0.5)."""

    @property
    def lens(self) -> Lens | None:
        """Distortion of the colour images that the sequence's files state; None if they state none."""
        return None

    @property
    @abstractmethod
    def up_axis(self) -> UpAxis:
        """Unit vector of the world frame that points up."""

    @property
    @abstractmethod
    def depth_registered(self) -> bool:
        """True if each depth pixel belongs to the colour pixel at the same place."""

    @property
    def camera_ideal(self) -> bool:
        """True if images have no lens distortion, rolling shutter and motion blur; no estimate is made then."""
        return False

    @property
    def poses_exact(self) -> bool:
        """True if the poses have no error; no estimate is made then, and poses are not refined."""
        return False

    @property
    def depth_unit_stated(self) -> bool:
        """True if the files or the format state the unit of depth; False if it is the layout's usual one."""
        return False

    @property
    def depth_unit_setting(self) -> str:
        """Where a user states another unit of depth, such as "`scale` in cam_params.json"; empty for nowhere."""
        return ""

    @property
    def world_frame(self) -> str:
        """Name of the poses' frame, the same for sequences that share it."""
        return self.name

    @property
    def regions_file(self) -> Path | None:
        """File of the ground-truth regions; None if there are none, or if the sequence computes them."""
        return None

    @property
    def description(self) -> str:
        """What is read, for the operator, where the address leaves it open, as the topics of a bag; else empty."""
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the operator: excluded frames and why, a camera file of another folder, a moved origin."""
        return ()

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i, resized to (width, height): colour by area, depth by nearest pixel.

        Raises DatasetError or PoseError with the name of the file.
        """

    @abstractmethod
    def indices(self) -> Sequence[int]:
        """Return the frame number of each position, ascending."""

    @abstractmethod
    def trajectory(self) -> Trajectory:
        """Return the pose at every position, at the frames' capture times. Raises DatasetError, PoseError."""

    def regions(self) -> Mapping[str, Region]:
        """Return ground-truth regions by object name; empty if the sequence has none."""
        return {}

    def with_true_poses(self) -> Source:
        """Return the sequence with the poses that estimates are scored against: its own, unless it has better ones."""
        return self


class SourceReader(Protocol):
    """Opens one kind of sequences. A package registers its readers in the group `gausslite.sources` of entry points.

    "NAME:REST", with the name of the entry point, is opened as REST by this reader. An address without a name goes to
    the first reader that recognises it.
    """

    @property
    def layout(self) -> str:
        """The folders that it opens, by names of their files, for messages; empty for none."""

    @property
    def address(self) -> str:
        """What it opens that is no folder, such as "a ROS bag", for messages; empty for none."""

    def recognises(self, address: str) -> bool:
        """True if an address without a name is of this kind, by the names of files."""

    def open(self, address: str, up_axis: UpAxis | None, require_poses: bool, /) -> Source:
        """Return the sequence, as `open_source` does. Raises DatasetError, PoseError, InvalidInputError."""


def require_position(source_name: str, i: int, count: int) -> None:
    """Raise DatasetError unless i is one of the positions 0 .. count - 1."""
    require_whole(f"{source_name} position", i)
    if not 0 <= i < count:
        raise DatasetError(
            f"{source_name}: expected a position from 0 to {count - 1}, got {i}; indices().index({i}) is the position "
            "of the frame with this number"
        )


def excluded_frames_note(count: int, recorded: int, reason: str) -> str:
    """Return the message on recorded frames that a sequence excludes; empty if there are none."""
    return f"{count} of {recorded} colour images are skipped: {reason}" if count else ""


def repeated_times_note(count: int, recorded: int) -> str:
    """Return the message on recorded frames with the time of an earlier one; empty if there are none."""
    return excluded_frames_note(count, recorded, "they have the time of the image before")


def require_matches(folder: Path, count: int, expected: str, times_s: Mapping[str, Sequence[float]]) -> None:
    """Raise DatasetError with the ranges of all times if no image has what belongs to it at its time."""
    if count == 0:
        ranges = (
            f"{name} from {min(times):.3f} to {max(times):.3f} s" for name, times in times_s.items() if len(times)
        )
        units = {name: unit for name, times in times_s.items() if len(times) and (unit := _probable_unit(max(times)))}
        advice = "are these times of the same clock?"
        if units:
            found = (f"those of {name} look like {unit}" for name, unit in units.items())
            advice = f"times are seconds, but {', '.join(found)}"
        raise DatasetError(f"{folder}: expected {expected}, got none: {', '.join(ranges)}; {advice}")


def _probable_unit(time: float) -> str:
    """Return the unit of a time since 1970 that is too large for seconds; empty for seconds."""
    limits = ((1e11, ""), (1e14, "milliseconds"), (1e17, "microseconds"))
    return next((unit for limit, unit in limits if time < limit), "nanoseconds")


def usable_frames(
    source: Source, positions: Iterable[int], size: tuple[int, int] | None = None
) -> Iterator[tuple[int, Frame]]:
    """Yield position and frame of those that can be read and have no defect; mapping reports the others."""
    for position in positions:
        with suppress(DatasetError, PoseError):
            frame = source.frame(position, size)
            if not frame.defect:
                yield position, frame


def select_frames(source: Source, selection: str) -> list[int]:
    """Return the positions of the frames whose number is in range(START, STOP, STEP) for the text "START:STOP:STEP".

    Each part is optional, as in a slice: "0:497", "500:1000:4", "::2". The numbers are those of `source.indices()`: a
    sequence with every fourth frame of a recording has no frame 1. Raises InvalidInputError if the text has another
    form and DatasetError if it selects no frame.
    """
    start, stop, step = _parse(selection)
    numbers = source.indices()
    selected = [
        i for i, n in enumerate(numbers) if n >= start and (stop is None or n < stop) and (n - start) % step == 0
    ]
    if not selected:
        raise DatasetError(
            f"{source.name}: no frame is in {selection!r}; its {len(numbers)} frames are "
            f"numbered {numbers[0]} to {numbers[-1]}"
        )
    return selected


def numbering_note(source: Source, selection: str) -> str:
    """Return the message that a selection is by numbers; empty if all are chosen, or if they are positions too."""
    numbers, count = source.indices(), len(select_frames(source, selection))
    if count == len(numbers) or numbers[-1] == len(numbers) - 1:
        return ""
    return (
        f"frames {selection}: {count} of {len(numbers)} are chosen by their numbers, which are "
        f"{', '.join(map(str, numbers[:3]))} ... {numbers[-1]}"
    )


def frame_step(selection: str) -> int:
    """Return STEP of the text "START:STOP:STEP", 1 without it. Raises InvalidInputError."""
    return _parse(selection)[2]


def frame_size(text: str | None, source: Source) -> tuple[int, int]:
    """Return (width, height) of "WxH", or the sequence's own size if text is None.

    Raises InvalidInputError if the size is not valid or changes the aspect ratio by more than one pixel.
    """
    if text is None:
        return source.camera.width_px, source.camera.height_px
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(_is_whole(part) for part in parts):
        raise InvalidInputError(f"size: expected WIDTHxHEIGHT such as 320x240, got {text[:40]!r}")
    width, height = int(parts[0]), int(parts[1])
    if not (16 <= width <= 4096 and 16 <= height <= 4096):
        raise InvalidInputError(f"size: expected sides of 16 to 4096 pixels, got {text!r}")
    _require_aspect_ratio(width, height, source.camera)
    return width, height


def capped_size(camera: Camera, max_pixels: int = 320 * 240) -> tuple[int, int]:
    """Return a size with the camera's aspect ratio and about this many pixels, or its own size if smaller."""
    scale = min(1.0, math.sqrt(max_pixels / (camera.width_px * camera.height_px)))
    return round(scale * camera.width_px), round(scale * camera.height_px)


def _require_aspect_ratio(width: int, height: int, camera: Camera) -> None:
    """Raise InvalidInputError unless one side is within a pixel of the camera's aspect ratio."""
    same_width = width * camera.height_px / camera.width_px
    same_height = height * camera.width_px / camera.height_px
    if abs(same_width - height) <= 1 or abs(same_height - width) <= 1:
        return
    raise InvalidInputError(
        f"size: expected the aspect ratio of {camera.width_px}x{camera.height_px}, got {width}x{height}; "
        f"the nearest sizes with it are {width}x{round(same_width)} and {round(same_height)}x{height}"
    )


def _parse(selection: str) -> tuple[int, int | None, int]:
    expected = "expected START:STOP or START:STOP:STEP with 0 <= START < STOP and STEP >= 1"
    parts = [part.strip() for part in selection.split(":")]
    if len(parts) not in (2, 3) or not all(part == "" or _is_whole(part) for part in parts):
        raise InvalidInputError(f"frames {selection[:40]!r}: {expected}")
    numbers = [int(part) if part else None for part in (*parts, "")[:3]]
    start, stop, step = numbers[0] or 0, numbers[1], 1 if numbers[2] is None else numbers[2]
    if step < 1 or (stop is not None and stop <= start):
        raise InvalidInputError(f"frames {selection!r}: {expected}")
    return start, stop, step


def _is_whole(text: str) -> bool:
    """True for at most 20 decimal digits: Python refuses to convert very long numbers."""
    return text.isascii() and text.isdigit() and len(text) <= 20


def _of_wrapped(name: str) -> Any:
    """Return a property that has the wrapped source's value."""
    return property(attrgetter(f"_source.{name}"))


class WrappedSource(Source):
    """All of a Source except `frame`, as the wrapped source has it; subclasses override what they change."""

    name = _of_wrapped("name")
    camera = _of_wrapped("camera")
    lens = _of_wrapped("lens")
    up_axis = _of_wrapped("up_axis")
    depth_registered = _of_wrapped("depth_registered")
    camera_ideal = _of_wrapped("camera_ideal")
    poses_exact = _of_wrapped("poses_exact")
    depth_unit_stated = _of_wrapped("depth_unit_stated")
    depth_unit_setting = _of_wrapped("depth_unit_setting")
    world_frame = _of_wrapped("world_frame")
    regions_file = _of_wrapped("regions_file")
    description = _of_wrapped("description")
    notes = _of_wrapped("notes")

    def __init__(self, source: Source) -> None:
        self._source = source

    def __len__(self) -> int:
        return len(self._source)

    def indices(self) -> Sequence[int]:
        """Return the frame numbers of the wrapped source."""
        return self._source.indices()

    def trajectory(self) -> Trajectory:
        """Return the poses of the wrapped source."""
        return self._source.trajectory()

    def regions(self) -> Mapping[str, Region]:
        """Return the regions of the wrapped source, which are in the world frame."""
        return self._source.regions()
