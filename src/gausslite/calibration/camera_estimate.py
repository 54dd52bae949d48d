"""Estimate how a camera's images differ from an ideal camera's: lens, readout time, time offset and exposure time.

Lens, readout and offset are those under which pairs of frames on moving stretches agree best (`MovingPairs`). The
radial lens minimises the photometric residual. The readout time minimises the residual and the rotation that the pose
fit needs, and the offset the rotation. The exposure time comes from blur (`estimate_exposure_time`). Each part is used
only if it explains a clear share of the disagreement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy import ndarray

from gausslite.calibration.exposure_time import estimate_exposure_time
from gausslite.calibration.moving_pairs import MovingPairs, PairError
from gausslite.datasets.selection import downscaled_size
from gausslite.datasets.source import Source
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.lens import Lens, LensModel

_MIN_PAIRS = 4
_MIN_LENS_PIXELS = 160 * 120
_READOUTS_S = (0.0, 0.015, 0.03, 0.045)
_OFFSETS_S = (-0.02, 0.0, 0.02)
_FINE_STEP_S = 0.0075
_RADIAL = (-0.3, -0.15, 0.0, 0.15, 0.3)
_FINE_RADIAL_STEP = 0.05
_SECOND_RADIAL = (-0.15, 0.0, 0.15)
_MIN_ROTATION_DEG = 0.01
_EXCHANGE = 0.4
"""Squared slope at which the two radial terms exchange: half way to the corner of an image 60 degrees wide."""
_MIN_TIMING_RESIDUAL_GAIN, _MIN_MOTION_GAIN = 0.005, 0.3
_CLEAR_MOTION_GAIN, _CLEAR_ROTATION_DEG, _MAX_RESIDUAL_LOSS = 0.6, 0.1, 0.02
_MIN_COARSE_LENS_GAIN, _MIN_LENS_RESIDUAL_GAIN, _MIN_SECOND_RADIAL_GAIN = 0.01, 0.03, 0.01


@dataclass(frozen=True, slots=True)
class CameraEstimate:
    """The correction to use, and the evidence for lens, times and exposure, one line each."""

    correction: CameraCorrection
    evidence: tuple[str, ...]


def estimate_camera(source: Source, known: CameraCorrection) -> CameraEstimate:
    """Return the correction with estimated lens, readout, offset and exposure, each used only if the gain is clear.

    A lens of `known` is kept. Frames that cannot be read are skipped. Depth must be registered to colour.
    """
    moving = MovingPairs.read(source, downscaled_size(source.camera))
    if len(moving.pairs) < _MIN_PAIRS:
        reason = f"{len(moving.pairs)} pairs of frames turn fast enough, expected at least {_MIN_PAIRS}"
        return CameraEstimate(known, (reason,))
    recorded = moving.error(known)
    if recorded.pairs < _MIN_PAIRS:
        reason = f"{recorded.pairs} pairs of frames can be compared, expected at least {_MIN_PAIRS}"
        return CameraEstimate(known, (reason,))
    evidence = []
    correction, coarse = known, moving.halved()
    width_px, height_px = source.camera.width_px, source.camera.height_px
    if known.lens is None and width_px * height_px < _MIN_LENS_PIXELS:
        # noise of tiny images looks like a lens
        evidence.append(f"lens: images of {width_px}x{height_px} pixels, expected at least 160x120")
    elif known.lens is None:
        correction, reason = _with_lens(moving, coarse, known)
        evidence.append(f"lens: {reason}")
    correction, reason = _with_times(moving, coarse, correction)
    evidence.append(f"readout and offset: {reason}")
    exposure_s, reason = estimate_exposure_time(source, correction)
    evidence.append(f"exposure: {reason}")
    return CameraEstimate(replace(correction, exposure_s=exposure_s), tuple(evidence))


def _with_lens(moving: MovingPairs, coarse: MovingPairs, known: CameraCorrection) -> tuple[CameraCorrection, str]:
    """Return `known` with a radial lens of one or two coefficients, if it lowers the residual clearly."""

    def residual(pairs: MovingPairs, k1: float, k2: float, readout_s: float) -> float:
        return pairs.error(replace(known, lens=_radial(k1, k2), readout_s=readout_s)).residual

    k1 = minimum(_RADIAL, lambda value: residual(coarse, value, 0.0, known.readout_s))
    before, after = (residual(coarse, value, 0.0, known.readout_s) for value in (0.0, k1))
    if after > (1.0 - _MIN_COARSE_LENS_GAIN) * before:
        gain = f"residual {before:.2f} becomes {after:.2f} of 255 with k1 = {k1:.2f}"
        return known, f"{gain}; no clear gain, not used"
    # a readout time left in the images would bias the lens
    readout_s = minimum(_READOUTS_S, lambda value: residual(coarse, k1, 0.0, value))
    k1 = minimum(_around(k1, _FINE_RADIAL_STEP), lambda value: residual(moving, value, 0.0, readout_s))
    two = _second_coefficient(k1, lambda first, second: residual(coarse, first, second, readout_s))
    pinhole, lens, wider = (
        moving.error(replace(known, lens=_radial(*slopes), readout_s=readout_s))
        for slopes in ((0.0, 0.0), (k1, 0.0), two)
    )
    slopes, best = (k1, 0.0), lens
    if wider.residual <= (1.0 - _MIN_SECOND_RADIAL_GAIN) * lens.residual:
        slopes, best = two, wider
    found = _radial(*slopes)
    gain = f"residual {pinhole.residual:.2f} becomes {best.residual:.2f} of 255 on {best.pairs} pairs"
    if best.residual <= (1.0 - _MIN_LENS_RESIDUAL_GAIN) * pinhole.residual:
        return replace(known, lens=found), f"{found}, {gain}"
    return known, f"{gain}; no clear gain, not used"


def _second_coefficient(k1: float, residual: Callable[[float, float], float]) -> tuple[float, float]:
    """Return both coefficients at the minimum over k2, with k1 at its own minimum for each k2."""
    best_k1 = {
        k2: minimum(_around(k1 - _EXCHANGE * k2, _FINE_RADIAL_STEP), partial(_swapped, residual, k2))
        for k2 in _SECOND_RADIAL
    }
    k2 = minimum(_SECOND_RADIAL, lambda value: residual(best_k1[value], value))
    return float(np.interp(k2, _SECOND_RADIAL, [best_k1[value] for value in _SECOND_RADIAL])), k2


def _swapped(residual: Callable[[float, float], float], k2: float, k1: float) -> float:
    return residual(k1, k2)


def _with_times(moving: MovingPairs, coarse: MovingPairs, known: CameraCorrection) -> tuple[CameraCorrection, str]:
    """Return `known` with readout time and time offset, if they lower residual and rotation clearly."""
    before, coarse_before = moving.error(known), coarse.error(known)
    readout_s = minimum(
        _READOUTS_S, lambda value: _relative(coarse.error(replace(known, readout_s=value)), coarse_before)
    )
    found = replace(known, readout_s=readout_s)
    offset_s = minimum(_OFFSETS_S, lambda value: moving.error(replace(found, time_offset_s=value)).rotation_deg ** 2)
    found = replace(found, time_offset_s=round(offset_s, 3) + 0.0)
    around_s = _around(readout_s, _FINE_STEP_S)
    readout_s = minimum(around_s, lambda value: _relative(moving.error(replace(found, readout_s=value)), before))
    found = replace(found, readout_s=round(readout_s, 3) + 0.0)
    after = moving.error(found)
    evidence = (
        f"{1e3 * found.readout_s:.0f} ms and {1e3 * found.time_offset_s:.0f} ms, {after.pairs} pairs of moving "
        f"frames: residual {before.residual:.2f} becomes {after.residual:.2f} of 255, "
        f"rotation error {before.rotation_deg:.2f} becomes {after.rotation_deg:.2f} deg"
    )
    if _explain_motion(before, after):
        return found, evidence
    return known, f"{evidence}; no clear gain, not used"


def _explain_motion(before: PairError, after: PairError) -> bool:
    """Return True if new times lower both errors, or the rotation so far that the residual need not fall.

    The pose fit hides a slow camera's readout from the residual: most of it looks like a rotation of the whole image.
    """
    rotation_gain = 1.0 - after.rotation_deg / max(before.rotation_deg, _MIN_ROTATION_DEG)
    residual_gain = 1.0 - after.residual / before.residual
    if rotation_gain >= _MIN_MOTION_GAIN and residual_gain >= _MIN_TIMING_RESIDUAL_GAIN:
        return True
    is_far = rotation_gain >= _CLEAR_MOTION_GAIN and before.rotation_deg >= _CLEAR_ROTATION_DEG
    return is_far and residual_gain >= -_MAX_RESIDUAL_LOSS


def _relative(error: PairError, before: PairError) -> float:
    """Return residual and squared rotation relative to those before, added: on few pairs, either alone is flat."""
    return error.residual / before.residual + (error.rotation_deg / max(before.rotation_deg, _MIN_ROTATION_DEG)) ** 2


def _radial(k1: float, k2: float) -> Lens:
    return Lens(LensModel.RADTAN, (round(k1, 3), round(k2, 3), 0.0, 0.0))


def _around(value: float, step: float) -> tuple[float, float, float]:
    return value - step, value, value + step


def minimum(values: Sequence[float], cost: Callable[[float], float]) -> float:
    """Return the minimum of a parabola through the best of evenly spaced values and its neighbours.

    A cost may be infinite: nothing could be compared at this value.
    """
    costs: ndarray = np.array([cost(value) for value in values])
    best = int(np.clip(np.argmin(costs), 1, len(values) - 2))
    a, b, c = map(float, costs[best - 1 : best + 2])
    curvature = a - 2 * b + c
    if not 0 < curvature < math.inf:
        return values[int(np.argmin(costs))]
    step = values[1] - values[0]
    return values[best] + step * float(np.clip(0.5 * (a - c) / curvature, -1.0, 1.0))
