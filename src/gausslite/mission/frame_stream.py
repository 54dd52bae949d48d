"""Select the frames of a sequence that a mission maps, and read them one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from gausslite.datasets.corrected_source import CorrectedSource
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.open import open_source
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.mission.settings import SourceSettings

OnCorrupt = Callable[[int, DatasetError | PoseError], None]
"""Gets the index and the error of each frame that cannot be read."""


def region_file_note(spec: str, source: Source) -> str | None:
    """Return a message if the ground-truth regions come from a file of the sequence's folder, else None."""
    if source.regions_file is None:
        return None
    return f"{spec}: the ground-truth regions of {source.regions_file.name} in the sequence's folder are used"


@dataclass(frozen=True, slots=True)
class FrameStream:
    """The selected positions of a sequence and the size of their images."""

    source: Source
    positions: Sequence[int]
    size: tuple[int, int]

    @classmethod
    def open(cls, settings: SourceSettings) -> FrameStream:
        """Open the sequence of the settings, registered and corrected, and select its frames.

        Raises DatasetError, PoseError, InvalidInputError.
        """
        source = open_source(settings.spec, settings.up_axis, settings.depth_registration, settings.require_poses)
        correction = settings.camera_correction
        if correction is not None and not correction.is_identity:
            source = CorrectedSource(source, correction)
        return cls.select(source, settings)

    @classmethod
    def select(cls, source: Source, settings: SourceSettings) -> FrameStream:
        """Return the frames that the settings select, without the frames kept for evaluation.

        Raises DatasetError if there are none, InvalidInputError.
        """
        positions: Sequence[int] = select_frames(source, settings.frames)
        if settings.test_every is not None:
            positions, _ = HeldOutSplit(settings.test_every).split(positions)
        return cls(source, positions, frame_size(settings.size, source))

    def __len__(self) -> int:
        return len(self.positions)

    def after(self, index: int) -> FrameStream:
        """Return the frames with a greater index."""
        indices = self.source.indices()
        return replace(self, positions=[position for position in self.positions if indices[position] > index])

    def frames(self, on_corrupt: OnCorrupt | None = None) -> Iterator[Frame]:
        """Yield each frame, read on request.

        Frames that cannot be read are skipped and passed to on_corrupt. Without on_corrupt they raise DatasetError or
        PoseError.
        """
        for position in self.positions:
            try:
                frame = self.source.frame(position, self.size)
            except (DatasetError, PoseError) as error:
                if on_corrupt is None:
                    raise
                on_corrupt(self.source.indices()[position], error)
                continue
            yield frame


class CorruptFrames:
    """Count the frames that cannot be read, and report each of them."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self.count = 0
        self.first_error: DatasetError | PoseError | None = None

    def __call__(self, index: int, error: DatasetError | PoseError) -> None:
        """Count one frame and report its error, which names the file."""
        self.count += 1
        self.first_error = self.first_error or error
        self._report(f"frame {index} skipped: {error}")
