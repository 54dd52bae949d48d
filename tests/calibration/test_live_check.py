"""What `map` refuses of a recording, live frames are refused for as well, by the same comparison."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

import gausslite as gl
from gausslite.datasets.open import open_source
from gausslite.domain.frame import TOO_FAR, Frame
from gausslite_calibration.live_check import LiveCheck

SIZE = (160, 120)
Change = Callable[[Frame], Frame]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    home = open_source("sim:home?size=160x120")
    return [home.frame(position, SIZE) for position in range(14)]


def along_ray(frame: Frame) -> Frame:
    x, y = frame.camera.slopes(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    factor = np.sqrt(1 + np.square(x)[None, :] + np.square(y)[:, None]).astype(np.float32)
    return replace(frame, depth_m=frame.depth_m * factor)


def half_size(frame: Frame) -> Frame:
    k = frame.camera
    return replace(frame, camera=gl.Camera(k.fx_px / 2, k.fy_px / 2, k.cx_px / 2, k.cy_px / 2, *SIZE))


WRONG: dict[str, Change] = {
    "world-to-camera poses": lambda f: replace(f, T_world_camera=np.linalg.inv(f.T_world_camera)),
    "OpenGL": lambda f: replace(f, T_world_camera=f.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])),
    "depth divided by": lambda f: replace(f, depth_m=f.depth_m * np.float32(10)),
    "depth along the ray": along_ray,
    "depth images mirrored": lambda f: replace(f, depth_m=np.ascontiguousarray(f.depth_m[:, ::-1])),
    "focal length multiplied by": half_size,
}
REST = np.eye(4)


def streamed(frames: list[Frame], change: Change = lambda frame: frame) -> Iterator[tuple[int, str]]:
    check = LiveCheck(False)
    for number, frame in enumerate(frames):
        yield number, check.refusal(change(frame))


def test_right_frames_are_mapped(frames: list[Frame]) -> None:
    assert not any(reason for _, reason in streamed(frames))


@pytest.mark.parametrize("reason", WRONG)
def test_wrong_frames_are_refused_with_what_would_agree(frames: list[Frame], reason: str) -> None:
    refused = dict(streamed(frames, WRONG[reason]))
    assert reason in refused[len(frames) - 1]
    assert "--set force=true" in refused[len(frames) - 1]


def test_poses_that_never_change_are_refused_and_a_camera_at_rest_is_not(frames: list[Frame]) -> None:
    moving = list(streamed(frames, lambda frame: replace(frame, T_world_camera=REST)))
    assert "do not fit the images" in moving[-1][1]
    noise = np.random.default_rng(1)

    def at_rest(frame: Frame) -> Frame:
        rgb = np.clip(frames[0].rgb + noise.normal(0, 8, frames[0].rgb.shape), 0, 255).astype(np.uint8)
        return replace(frame, rgb=rgb, depth_m=frames[0].depth_m, T_world_camera=REST)

    assert not any(reason for _, reason in streamed(frames, at_rest))


def test_unregistered_depth_is_named_once_and_mapped(frames: list[Frame]) -> None:
    check, notes = LiveCheck(False), set[str]()
    for frame in frames * 3:
        assert check.refusal(replace(frame, camera=frame.camera.zoomed(1.24))) == ""
        notes.update(check.notes)
    (note,) = notes
    assert "not registered to the colour image" in note
    assert "gausslite calibrate" in note


def test_frames_are_mapped_again_when_they_are_corrected(frames: list[Frame]) -> None:
    check = LiveCheck(False)
    assert [check.refusal(WRONG["OpenGL"](frame)) for frame in frames][-1] != ""
    later = [replace(frame, capture_time_ns=frame.capture_time_ns + 10**9) for frame in frames]
    assert [check.refusal(frame) for frame in later][-1] == ""
    assert "OpenGL" in check.notes[0]


@pytest.mark.parametrize("force", [False, True])
def test_the_mapper_of_the_python_api_refuses_unless_forced(frames: list[Frame], force: bool) -> None:
    settings = gl.MissionSettings(policy="uniform", iterations=0, threads=1, force=force)
    mapper = gl.create_mapper(gl.SceneInfo(), settings=settings)
    outcomes = [mapper.process(WRONG["OpenGL"](frame)) for frame in frames]
    assert ("OpenGL" in str(outcomes[-1].skipped)) is not force
    assert any("OpenGL" in note for note in mapper.notes) is not force


def test_depth_in_millimetres_is_named(frames: list[Frame]) -> None:
    mapper = gl.create_mapper(gl.SceneInfo(), settings=gl.MissionSettings(policy="uniform", iterations=0, threads=1))
    outcome = mapper.process(replace(frames[0], depth_m=frames[0].depth_m * np.float32(1000)))
    assert outcome.skipped == TOO_FAR
