"""Find things by their colour: `--detector FILE.colours`, with a line such as `mug 190 25 30` for each thing."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.relevance import Detection
from gausslite.perception.detector import bounding_box
from gausslite.perception.detector_file import DetectorOptions

MAX_DIFFERENCE, MIN_PIXELS = 40, 12


class ColourDetector:
    """A `Detector` of parts of the image with the colour of a noun."""

    def __init__(self, colours: dict[str, tuple[int, ...]]) -> None:
        self._colours = colours

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return which nouns have a colour."""
        unknown, known = MatchBasis.NONE, tuple(self._colours)
        return tuple(
            NounMatch(noun, MatchBasis.NAME, (noun,)) if noun in known else NounMatch(noun, unknown, known=known)
            for noun in queries
        )

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the parts of the image with a noun's colour, the largest first."""
        found = []
        for noun in [query for query in queries if query in self._colours]:
            colour = np.array(self._colours[noun])
            is_near = cv2.inRange(frame.rgb, np.maximum(colour - MAX_DIFFERENCE, 0), colour + MAX_DIFFERENCE)
            parts, part_of_pixel = cv2.connectedComponents(is_near)
            masks = [part_of_pixel == part for part in range(1, parts)]
            for mask in sorted(masks, key=np.count_nonzero, reverse=True):
                box_px = bounding_box(mask)
                if box_px is not None and np.count_nonzero(mask) >= MIN_PIXELS:
                    found.append(Detection(noun, 0.9, box_px, mask))
        return found


class ColourReader:
    """The `DetectorReader` of `.colours` files."""

    def open(self, path: Path, _: DetectorOptions) -> ColourDetector | None:
        """Return the detector of a `.colours` file; None for another file."""
        if path.suffix != ".colours":
            return None
        try:
            rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
            return ColourDetector({" ".join(name): (int(r), int(g), int(b)) for *name, r, g, b in rows})
        except (OSError, ValueError) as error:
            raise ModelFileError(f"{path}: expected lines such as 'mug 190 25 30', but {error}") from error

    def advice(self) -> str:
        """Return how to get a file."""
        return "write FILE.colours with a line such as 'mug 190 25 30' for each thing"


READER = ColourReader()
