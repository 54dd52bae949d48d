"""Place descriptors: exact bytes, the same place before others, and bounded sizes."""

import numpy as np
import pytest
from place_scenes import MapCamera, looking, room

from gausslite.domain.errors import CodecError
from gausslite_places.descriptors import DESCRIPTOR_BYTES, PlaceDescriptor, PlaceIndex, describe


def _index(cameras: list[MapCamera], yaws_deg: list[int]) -> PlaceIndex[tuple[int, int]]:
    index: PlaceIndex[tuple[int, int]] = PlaceIndex()
    for number, camera in enumerate(cameras):
        for yaw_deg in yaws_deg:
            frame = camera.frame(looking(2.0, 1.5, yaw_deg))
            index.add((number, yaw_deg), describe(frame.rgb, frame.depth_m))
    return index


def test_the_bytes_are_exact_and_at_most_500() -> None:
    frame = MapCamera(room()).frame(looking(1.0, 1.5, 0))
    descriptor = describe(frame.rgb, frame.depth_m)
    data = descriptor.encode()
    assert len(data) == DESCRIPTOR_BYTES <= 500
    assert PlaceDescriptor.decode(data).encode() == data
    assert descriptor.similarity(PlaceDescriptor.decode(data)) == pytest.approx(1.0, abs=1e-5)
    pytest.raises(CodecError, PlaceDescriptor.decode, data[1:]).match("expected 448 bytes, got 447")


def test_a_view_from_a_step_aside_finds_its_place_first() -> None:
    cameras, yaws_deg = [MapCamera(room(seed)) for seed in range(3)], list(range(0, 360, 45))
    index = _index(cameras, yaws_deg)
    found = 0
    for number, camera in enumerate(cameras):
        for yaw_deg in yaws_deg:
            frame = camera.frame(looking(2.1, 1.4, yaw_deg + 6))
            found += (number, yaw_deg) in dict(index.candidates(describe(frame.rgb, frame.depth_m), 3))
    assert found >= 20  # of 24; by chance 3


def test_candidates_are_ordered_limited_and_stable() -> None:
    index = _index([MapCamera(room())], [0, 90, 0])
    frame = MapCamera(room()).frame(looking(2.0, 1.5, 0))
    candidates = index.candidates(describe(frame.rgb, frame.depth_m), 2)
    assert [key for key, _ in candidates] == [(0, 0), (0, 0)]
    assert candidates[0][1] == pytest.approx(1.0, abs=1e-5)
    assert len(index.candidates(describe(frame.rgb, frame.depth_m), 10)) == len(index) == 3


def test_images_without_texture_or_depth_have_a_descriptor() -> None:
    index: PlaceIndex[str] = PlaceIndex()
    blank = describe(np.zeros((12, 16, 3), np.uint8), np.zeros((12, 16), np.float32))
    assert index.candidates(blank, 3) == []
    index.add("blank", blank)
    assert np.isfinite(index.candidates(blank, 3)[0][1])
