"""The tests check the shapes of arrays in every annotation: of functions, of dataclasses, and behind names of types."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from support.shape_checks import has_array

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.pose import Trajectory, inverse
from gausslite_sim import textures

CAMERA = Camera.centred(10.0, 8, 6)


@pytest.mark.parametrize(
    "call",
    [
        lambda: inverse(np.eye(3)),
        lambda: inverse(np.eye(4, dtype=np.float32)),
        lambda: back_project(np.zeros(6, np.float32), CAMERA),
        lambda: Trajectory(np.zeros((1, 2)), np.eye(4)[None]),
        lambda: textures.tint(np.zeros(4), (1.0, 1.0, 1.0)),
    ],
    ids=["shape", "type", "dimensions", "dataclass", "name of a type"],
)
def test_a_wrong_array_is_refused(call) -> None:
    pytest.raises(TypeCheckError, call)


@pytest.mark.parametrize(
    ("annotation", "expected"),
    [
        ('Float64[ndarray, "4 4"]', True),
        ('tuple[UInt8[ndarray, "3"], int] | None', True),
        ("Sequence[Shade]", True),
        ("dict[str, Colour]", False),
    ],
)
def test_arrays_are_found_in_annotations(annotation: str, expected: bool) -> None:
    assert has_array(annotation, vars(textures)) == expected
