"""The simulated home stays as it is: figures measured in it are only comparable while it does."""

from __future__ import annotations

import json

import numpy as np
from generate_simulated_home import GOLDEN, summarise


def test_the_home_looks_as_recorded() -> None:
    recorded, now = json.loads(GOLDEN.read_text()), summarise()
    assert recorded.keys() == now.keys()
    for key, frame in now.items():
        # another processor may round a ray or a lattice of noise differently, never shift a whole block
        assert np.abs(np.subtract(frame["colour"], recorded[key]["colour"])).max() <= 3, key
        assert np.abs(np.subtract(frame["depth_cm"], recorded[key]["depth_cm"])).max() <= 2, key
        for name, pixels in frame["pixels"].items():
            assert abs(pixels - recorded[key]["pixels"][name]) <= 4, (key, name)
