"""Compare live frames with their poses, as `find_contradiction` compares a recording's, while they arrive."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, capped_size
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, UpAxis, rotation_angle_deg, translation_m
from gausslite_calibration.consistency import Contradiction, find_contradiction

_WINDOW, _FIRST = 24, 12
"""Frames that are compared, and with how many the first comparison is made; the next follow after twice as many each,
or after _FIRST more while frames are refused."""
_LEAST_MOTION_M, _LEAST_MOTION_DEG, _LONGEST_REST_NS, _LEAST_CHANGE = 0.01, 0.5, 500_000_000, 4.0
"""Frames of a robot at rest show nothing: within these of the last frame that is compared, a frame is left out. The
last one is the mean change of the image in grey levels: poses that never change do not show that the camera rests."""
_BLOCKS = (16, 12)
_ADVICE = (
    "expected T_world_camera (camera to world; camera axes x right, y down, z forward), depth in metres along the "
    "optical axis and the camera's own intrinsics; correct what is sent, or map it as it is with --set force=true"
)
_UNREGISTERED = (
    "depth that is not registered to the colour image looks so, and colours then lie beside their objects: register it "
    "before it is sent (of a recording, `gausslite calibrate` prints register-depth, which `map` and an agent with "
    "--source take); if it is registered, correct the intrinsics"
)


class FrameWindow(Source):
    """Frames of one camera as a sequence, for what compares sequences."""

    def __init__(self, frames: Sequence[Frame], depth_registered: bool = True) -> None:
        self._frames, self._depth_registered = tuple(frames), depth_registered

    name = "live frames"
    up_axis: UpAxis = (0.0, 0.0, 1.0)

    @property
    def camera(self) -> Camera:
        """The frames' camera."""
        return self._frames[0].camera

    @property
    def depth_registered(self) -> bool:
        """What is assumed of the depth images."""
        return self._depth_registered

    def __len__(self) -> int:
        return len(self._frames)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:  # noqa: ARG002
        """Return the frame at position i, which has at most the size that comparisons ask for."""
        return self._frames[i]

    def indices(self) -> Sequence[int]:
        """Return the frames' own numbers."""
        return [frame.index for frame in self._frames]

    def trajectory(self) -> Trajectory:
        """Return the frames' poses."""
        times_s = np.array([frame.capture_time_ns for frame in self._frames]) / 1e9
        return Trajectory(times_s - times_s[0], np.stack([frame.T_world_camera for frame in self._frames]))


class LiveCheck:
    """Refuses frames while the last comparison found a contradiction. Not thread-safe."""

    def __init__(self, in_background: bool) -> None:
        self._executor = ThreadPoolExecutor(1, "compare frames") if in_background else None
        self._window: deque[Frame] = deque(maxlen=_WINDOW)
        self._kept, self._next = 0, _FIRST
        self._comparing: Future[Contradiction | None] | None = None
        self._refusal = ""
        self._note = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found last."""
        return (self._note,) if self._note else ()

    def refusal(self, frame: Frame) -> str:
        """Return why poses or depth contradict the images; empty if they do not, or are not compared yet."""
        self._keep(compared(frame))
        if self._comparing is None and self._kept >= self._next:
            self._compare()
        if self._comparing is not None and self._comparing.done():
            found, self._comparing = self._comparing.result(), None
            self._apply(found)
        return self._refusal

    def restart(self) -> None:
        """Compare the next frames with none of the earlier ones."""
        self._window.clear()
        self._kept, self._next = 0, _FIRST

    def _keep(self, frame: Frame) -> None:
        """Add a frame to the window if it may show something new; a new camera or clock begins another window."""
        if self._window and not _is_later(self._window[-1], frame):
            self.restart()
        if self._window and _at_rest(self._window[-1], frame):
            return
        self._kept += 1
        self._window.append(frame)

    def _compare(self) -> None:
        frames = tuple(self._window)
        if self._executor is not None:
            self._comparing = self._executor.submit(_contradiction, frames)
            return
        self._comparing = Future()
        self._comparing.set_result(_contradiction(frames))

    def _apply(self, found: Contradiction | None) -> None:
        is_refused = found is not None and not found.is_small
        # the same cause keeps its figures, so that it is logged once
        if found is not None and _cause(str(found)) != _cause(self._note):
            self._note = str(found)
        self._refusal = self._note if is_refused else ""
        if is_refused:
            # corrected frames are not compared with these
            self._window.clear()
        self._next = self._kept + _FIRST if is_refused else 2 * max(self._kept, _FIRST)


def _contradiction(frames: Sequence[Frame]) -> Contradiction | None:
    """Return how live frames contradict each other, and what to do. Unregistered depth is mapped, as by `map`."""
    found = find_contradiction(FrameWindow(frames))
    if found is None or found.is_small:
        return found
    unregistered = find_contradiction(FrameWindow(frames, depth_registered=False))
    if unregistered is None or unregistered.is_small:
        return replace(found, text=f"{found.text.partition(';')[0]}; {_UNREGISTERED}", is_small=True)
    return replace(found, text=f"{found}; {_ADVICE}")


def _cause(note: str) -> str:
    return "".join(letter for letter in note if letter.isalpha())


def compared(frame: Frame) -> Frame:
    """Return the frame in the size that comparisons ask for."""
    image = RgbdImage(frame.rgb, frame.depth_m, frame.camera)
    return replace(resize_rgbd(image, capped_size(frame.camera)).in_frame(frame), recorded_rgb=None)


def _is_later(last: Frame, frame: Frame) -> bool:
    """True for a frame of the same camera and clock."""
    return last.camera == frame.camera and frame.capture_time_ns >= last.capture_time_ns


def _at_rest(last: Frame, frame: Frame) -> bool:
    moved_m = translation_m(last.T_world_camera, frame.T_world_camera)
    turned_deg = rotation_angle_deg(last.T_world_camera, frame.T_world_camera)
    waited_ns = frame.capture_time_ns - last.capture_time_ns
    is_still = moved_m < _LEAST_MOTION_M and turned_deg < _LEAST_MOTION_DEG and waited_ns < _LONGEST_REST_NS
    return is_still and float(np.abs(_blocks(frame) - _blocks(last)).mean()) < _LEAST_CHANGE


def _blocks(frame: Frame) -> Float32[ndarray, "h w"]:
    """Return the mean grey levels of large blocks, which noise does not change."""
    grey: Float32[ndarray, "h w"] = cv2.resize(frame.rgb, _BLOCKS, interpolation=cv2.INTER_AREA).mean(axis=2)
    return grey.astype(np.float32)
