"""Estimate a camera's exposure time from motion blur, which removes gradients along the image motion only.

A slower frame is warped into a fast one. Each of the two is then blurred along the motion of the other, for a trial
exposure time. At the right time both images have the same blur, so the ratio of gradient energy along and across the
motion is equal. The scene's own directions cancel, because both images show the same surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.datasets.source import Source, capped_size, usable_frames
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, Twist, inverse
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.corrected import correct_frame, is_steady, typical_image_speed
from gausslite_calibration.moving_pairs import warp_into

_MAX_PAIRS, _MIN_PAIRS = 16, 4
_MAX_TURN_RAD, _MAX_DISTANCE_M = math.radians(25.0), 0.8
_MAX_SPEED_SHARE = 0.7
"""Speed of the slower frame relative to the fast one."""
_STEP_S, _COARSE_STEPS, _MAX_STEPS = 0.002, 4, 20
_TYPICAL_EXPOSURE_S = 0.01
_MIN_BLUR_PX = 1.0
_MAX_RELATIVE_STD = 0.15
_BLUR_SAMPLES = 7
_SMOOTHING_PX = 0.8
_MIN_PIXELS, _MASK_MARGIN_PX = 2000, 9
_MAX_ANALYSIS_PIXELS = 640 * 480
_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)

Image = Float32[ndarray, "h w"]


@dataclass(frozen=True, slots=True)
class _PairTime:
    """Exposure time of one pair, how fast the ratio of gradients changes with it, and the fast frame's motion."""

    exposure_s: float
    weight: float
    speed_px_s: float


def estimate_exposure_time(source: Source, correction: CameraCorrection) -> tuple[float, str]:
    """Return the exposure time in seconds, 0 without clear blur, and the evidence.

    Frames are corrected for lens and readout first. Frames that cannot be read are skipped.
    """
    trajectory = source.trajectory()
    positions = _speed_pairs(trajectory)
    involved = sorted({i for pair in positions for i in pair})
    frames = usable_frames(source, involved, capped_size(source.camera, _MAX_ANALYSIS_PIXELS))
    corrected = {i: correct_frame(frame, correction, frame.camera, trajectory.twist(i)) for i, frame in frames}
    times = [
        time
        for slow, fast in positions
        if slow in corrected and fast in corrected
        for time in _pair_time(corrected[slow], corrected[fast], trajectory.twist(slow), trajectory.twist(fast))
    ]
    if len(times) < _MIN_PAIRS:
        return 0.0, f"{len(times)} pairs of a fast and a slower frame show blur, expected at least {_MIN_PAIRS}"
    exposure_s = _weighted_median([(time.exposure_s, time.weight) for time in times])
    deviation_s = 1.4826 * _weighted_median([(abs(time.exposure_s - exposure_s), time.weight) for time in times])
    std_s = deviation_s / math.sqrt(len(times))
    blur_px = exposure_s * float(np.median([time.speed_px_s for time in times]))
    evidence = (
        f"{1e3 * exposure_s:.1f} ms, standard error {1e3 * std_s:.1f} ms, from {len(times)} pairs of a fast and a "
        f"slower frame; fast frames are blurred by {blur_px:.1f} px"
    )
    if blur_px < _MIN_BLUR_PX or std_s > _MAX_RELATIVE_STD * exposure_s:
        return 0.0, f"{evidence}; no clear blur, not used"
    return round(exposure_s, 4), evidence


def _speed_pairs(trajectory: Trajectory) -> list[tuple[int, int]]:
    """Return positions (slow, fast) of frames that show the same surfaces at different speeds, fastest first."""
    poses = trajectory.T_world_camera
    twists = [trajectory.twist(i) for i in range(len(poses))]
    speeds = np.array([typical_image_speed(twist) for twist in twists])
    separation = max(1, len(speeds) // (4 * _MAX_PAIRS))
    pairs: list[tuple[int, int]] = []
    for fast in np.argsort(-speeds).tolist():
        if len(pairs) == _MAX_PAIRS:
            break
        if any(abs(fast - other) < separation for _, other in pairs) or not is_steady(trajectory, fast):
            continue
        cosine = 0.5 * (np.einsum("nij,ij->n", poses[:, :3, :3], poses[fast, :3, :3]) - 1.0)
        is_near = np.linalg.norm(poses[:, :3, 3] - poses[fast, :3, 3], axis=1) < _MAX_DISTANCE_M
        usable = np.flatnonzero(
            (cosine > math.cos(_MAX_TURN_RAD)) & is_near & (speeds < _MAX_SPEED_SHARE * speeds[fast])
        )
        if len(usable):
            pairs.append((int(usable[np.argmin(speeds[usable])]), fast))
    return pairs


def _pair_time(slow: Frame, fast: Frame, slow_twist: Twist, fast_twist: Twist) -> Iterator[_PairTime]:
    """Yield the exposure time of the pair, unless the two show too little in common or no blur."""
    warped = warp_into(slow, fast)
    margin = np.ones((_MASK_MARGIN_PX, _MASK_MARGIN_PX), np.uint8)
    mask = cv2.erode((warped.alpha > 0).astype(np.uint8), margin, borderValue=0) > 0
    if np.count_nonzero(mask) < _MIN_PIXELS:
        return
    reach_px = _MASK_MARGIN_PX // 2  # of the filters around the mask
    rows, columns = (slice(at.min() - reach_px, at.max() + reach_px + 1) for at in np.nonzero(mask))
    window = rows, columns
    mask, points = mask[window], _points(fast)[window]
    T_slow_fast = inverse(slow.T_world_camera) @ fast.T_world_camera
    points_in_slow = points @ T_slow_fast[:3, :3].T + T_slow_fast[:3, 3]
    fast_motion = _image_motion(points, fast.camera, fast_twist)
    slow_motion = _image_motion(points_in_slow, slow.camera, slow_twist)
    speed_px_s = np.maximum(np.linalg.norm(fast_motion, axis=2), 1e-6)
    direction = (fast_motion / speed_px_s[..., None])[mask]
    slow_image = warped.rgb @ _LUMINANCE
    fast_image = fast.rgb @ (_LUMINANCE / np.float32(255.0))

    def excess(exposure_s: float) -> float:
        """Return by how much the slower frame is still sharper along the motion; 0 at the right time."""
        blurred_slow = _blur(slow_image, window, fast_motion * np.float32(exposure_s))
        blurred_fast = _blur(fast_image, window, slow_motion * np.float32(exposure_s))
        return _sharpness_along(blurred_slow, direction, mask) - _sharpness_along(blurred_fast, direction, mask)

    found = _first_zero(excess)
    if found is not None:
        yield _PairTime(*found, float(np.median(speed_px_s[mask])))


def _first_zero(excess: Callable[[float], float]) -> tuple[float, float] | None:
    """Return where a falling function crosses zero and its slope there, None if it does not cross it.

    A pair whose fast frame is at least as sharp counts as 0 s: without it, the others would feign blur.
    """
    first = excess(0.0)
    if first <= 0:
        return 0.0, max(first - excess(_TYPICAL_EXPOSURE_S), 0.0) / _TYPICAL_EXPOSURE_S
    low, before = 0, first
    for high in range(_COARSE_STEPS, _MAX_STEPS + 1, _COARSE_STEPS):
        after = excess(high * _STEP_S)
        if after <= 0:
            break
        low, before = high, after
    else:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        value = excess(middle * _STEP_S)
        if value > 0:
            low, before = middle, value
        else:
            high, after = middle, value
    return _STEP_S * (low + before / (before - after)), (before - after) / _STEP_S


def _points(frame: Frame) -> Float64[ndarray, "h w 3"]:
    """Return every pixel's point in the camera's axes, at the median depth where the frame has none."""
    known = frame.depth_m > 0
    z_m = np.where(known, frame.depth_m, np.median(frame.depth_m[known])).astype(np.float64)
    camera = frame.camera
    x, y = camera.slopes(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    return np.stack([x[None, :] * z_m, y[:, None] * z_m, z_m], axis=2)


def _image_motion(points: Float64[ndarray, "h w 3"], camera: Camera, twist: Twist) -> Float32[ndarray, "h w 2"]:
    """Return the image velocity of points in the camera's axes, in pixels per second."""
    z_m = np.maximum(points[..., 2], 1e-2)
    (x, y, z), (wx, wy, wz) = np.moveaxis(points, 2, 0), twist.angular_rad_s
    turned = np.stack([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x], axis=2)
    rate = -(turned + twist.linear_m_s) / z_m[..., None]
    motion_px_s = camera.pixels_per_s(points[..., 0] / z_m, points[..., 1] / z_m, rate)
    return np.stack(motion_px_s, axis=2).astype(np.float32)


def _blur(image: Image, window: tuple[slice, slice], motion_px: Float32[ndarray, "m n 2"]) -> Float32[ndarray, "m n"]:
    """Return a window of the mean of the image over a motion of this length around each pixel."""
    rows, columns = (at.astype(np.float32) for at in np.ogrid[window])
    # the middle one of the samples is the image itself
    total: Float32[ndarray, "m n"] = image[window].copy()
    for sample in range(1, _BLUR_SAMPLES // 2 + 1):
        offset_px = motion_px * np.float32(sample / _BLUR_SAMPLES)
        for at in (np.add, np.subtract):
            lookup = at(columns, offset_px[..., 0]), at(rows, offset_px[..., 1])
            total += cv2.remap(image, *lookup, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return total / np.float32(_BLUR_SAMPLES)


def _sharpness_along(image: Image, direction: Float32[ndarray, "n 2"], mask: Bool[ndarray, "h w"]) -> float:
    """Return the logarithm of the gradient energy along a direction relative to that across it."""
    smooth = cv2.GaussianBlur(image, (0, 0), _SMOOTHING_PX)
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3)[mask]
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)[mask]
    x, y = direction.T
    along, across = dx * x + dy * y, dy * x - dx * y
    return math.log((float(along @ along) + 1e-12) / (float(across @ across) + 1e-12))


def _weighted_median(values: list[tuple[float, float]]) -> float:
    """Return the value at which half of the weight is reached, from pairs of value and weight."""
    ordered = sorted(values)
    total = np.cumsum([weight for _, weight in ordered])
    return ordered[int(np.searchsorted(total, 0.5 * total[-1]))][0]
