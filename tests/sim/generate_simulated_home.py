"""Write simulated_home.json, the recorded images of test_golden_home.py. Run this after an intended change."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gausslite.datasets.open import open_source

GOLDEN = Path(__file__).with_name("simulated_home.json")
COARSE = (8, 6)


def summarise() -> dict[str, Any]:
    """Return coarse means of a few frames per trajectory: colour, exact depth in cm, and pixels of some objects."""
    summary: dict[str, Any] = {}
    for trajectory in range(3):
        source = open_source(f"sim:home?seed=0&trajectory={trajectory}&frames=4&size=160x120&noise=0")
        regions = source.regions()
        for i in range(len(source)):
            frame = source.frame(i)
            depth_cm = cv2.resize(frame.depth_m * 100, COARSE, interpolation=cv2.INTER_AREA)
            summary[f"{trajectory}/{i}"] = {
                "colour": cv2.resize(frame.rgb, COARSE, interpolation=cv2.INTER_AREA).ravel().tolist(),
                "depth_cm": np.rint(depth_cm).astype(int).ravel().tolist(),
                "pixels": {name: int(regions[name].mask(frame).sum()) for name in ("mug", "chair_3", "sofa", "table")},
            }
    return summary


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps(summarise(), separators=(",", ":")).replace('},"', '},\n"') + "\n")
