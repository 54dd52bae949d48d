"""Render docs/homes.jpg: two views of each benchmark home."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

import gausslite as gl
from gausslite_sim.home_catalogue import HOME_COUNT

SHEET = Path(__file__).resolve().parents[1] / "docs" / "homes.jpg"
VIEWS = (
    *((0, 1), (0, 4), (0, 0), (0, 3), (0, 2), (0, 6), (0, 2), (0, 8)),
    *((0, 0), (2, 3), (0, 4), (0, 8), (0, 3), (2, 4), (0, 2), (0, 5)),
)
"""(trajectory, frame of ten), two for each home."""


def main() -> None:
    cells = []
    for home in range(1, HOME_COUNT + 1):
        for trajectory, frame in VIEWS[2 * home - 2 : 2 * home]:
            source = gl.open_sequence(f"sim:home-{home}?trajectory={trajectory}&frames=10&size=240x180&noise=0")
            cells.append(source.frame(frame).rgb)
    rows = [np.concatenate(cells[i : i + 4], axis=1) for i in range(0, len(cells), 4)]
    sheet = cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(SHEET), sheet, [cv2.IMWRITE_JPEG_QUALITY, 84])


if __name__ == "__main__":
    main()
