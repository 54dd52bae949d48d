"""The simulated home does not change: results measured in it must stay comparable."""

import json

import numpy as np
from generate_simulated_home import GOLDEN, summarise


def test_the_home_matches_the_recorded_images() -> None:
    recorded, current = json.loads(GOLDEN.read_text()), summarise()
    assert recorded.keys() == current.keys()
    for key, frame in current.items():
        # processors may round a ray or the noise differently, but never shift a whole block
        assert np.abs(np.subtract(frame["colour"], recorded[key]["colour"])).max() <= 3, key
        assert np.abs(np.subtract(frame["depth_cm"], recorded[key]["depth_cm"])).max() <= 2, key
        for name, pixels in frame["pixels"].items():
            assert abs(pixels - recorded[key]["pixels"][name]) <= 4, (key, name)
