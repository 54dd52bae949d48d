"""Estimate how a camera's images differ from an ideal camera's: lens, readout time, time offset and exposure time.

Lens, readout and offset are those under which pairs of frames on moving stretches agree best (`MovingPairs`). A coarse
search over one radial coefficient and the readout time is the start of a joint fit (`fit_camera`). The exposure time
comes from blur (`estimate_exposure_time`). Each part is used only if it explains a clear share of the disagreement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

from gausslite.datasets.source import Source, capped_size
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.corrected import ideal_camera
from gausslite_calibration.exposure_time import estimate_exposure_time
from gausslite_calibration.joint_camera_fit import CameraFit, fit_camera
from gausslite_calibration.moving_pairs import MovingPairs, PairError

_MIN_PAIRS = 4
_MIN_LENS_PIXELS = 160 * 120
_READOUTS_S = (0.0, 0.015, 0.03, 0.045)
_RADIAL = (-0.3, -0.15, 0.0, 0.15, 0.3)
_MIN_ROTATION_DEG = 0.01
_MIN_TIMING_RESIDUAL_GAIN, _MIN_MOTION_GAIN = 0.005, 0.3
_CLEAR_STDS, _CLEAR_TIME_S, _CLEAR_ROTATION_DEG, _MAX_RESIDUAL_LOSS = 5.0, 0.004, 0.1, 0.03
_CERTAIN_STDS, _CERTAIN_TIME_S = 15.0, 0.008
"""Times this far from 0 count although drifting poses hide what they change: without shutter, fits stay below 1 ms."""
_MIN_COARSE_LENS_GAIN, _MIN_LENS_RESIDUAL_GAIN = 0.01, 0.03
_CLEAR_RADIAL_STDS, _CLEAR_RADIAL, _CLEAR_LENS_RESIDUAL_GAIN = 10.0, 0.02, 0.01


@dataclass(frozen=True, slots=True)
class CameraEstimate:
    """The correction to use, and the evidence for lens, times and exposure, one line each."""

    correction: CameraCorrection
    evidence: tuple[str, ...]


def estimate_camera(source: Source, known: CameraCorrection) -> CameraEstimate:
    """Return the correction with estimated lens, readout, offset and exposure, each used only if the gain is clear.

    A lens of `known` is kept. Frames that cannot be read are skipped. Depth must be registered to colour.
    """
    moving = MovingPairs.read(source, capped_size(source.camera))
    if len(moving.pairs) < _MIN_PAIRS:
        reason = f"{len(moving.pairs)} pairs of frames turn fast enough, expected at least {_MIN_PAIRS}"
        return CameraEstimate(known, (reason,))
    recorded = moving.error(known)
    if recorded.pairs < _MIN_PAIRS:
        reason = f"{recorded.pairs} pairs of frames can be compared, expected at least {_MIN_PAIRS}"
        return CameraEstimate(known, (reason,))
    evidence = []
    correction, coarse = known, moving.halved()
    if coarse.error(known).residual <= 0.0:
        return CameraEstimate(known, ("the images have no contrast, nothing can be compared",))
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
    """Return `known` with a radial lens of two coefficients, if it lowers the residual clearly."""

    def with_lens(k1: float) -> CameraCorrection:
        return replace(known, lens=Lens(LensModel.RADTAN, (k1, 0.0, 0.0, 0.0)))

    k1 = minimum(_RADIAL, lambda value: coarse.error(with_lens(value)).residual)
    before, after = (coarse.error(with_lens(value)).residual for value in (0.0, k1))
    if after > (1.0 - _MIN_COARSE_LENS_GAIN) * before:
        gain = f"residual {before:.2f} becomes {after:.2f} of 255 with k1 = {k1:.2f}"
        return known, f"{gain}; no clear gain, not used"
    # a readout time left in the images would bias the lens
    fit = fit_camera(moving, _with_coarse_readout(coarse, with_lens(k1)), fits_lens=True)
    if fit is None or fit.correction.lens is None:
        return known, "too few pairs of frames can be compared, not used"
    found = replace(
        fit.correction.lens, coefficients=tuple(round(value, 3) for value in fit.correction.lens.coefficients)
    )
    pinhole, lens = (moving.error(replace(fit.correction, lens=value)) for value in (None, found))
    gain = f"residual {pinhole.residual:.2f} becomes {lens.residual:.2f} of 255 on {lens.pairs} pairs"
    is_clear = abs(fit.radial) >= max(_CLEAR_RADIAL_STDS * fit.radial_std, _CLEAR_RADIAL)
    least_gain = _CLEAR_LENS_RESIDUAL_GAIN if is_clear else _MIN_LENS_RESIDUAL_GAIN
    if lens.residual > (1.0 - least_gain) * pinhole.residual:
        return known, f"{gain}; no clear gain, not used"
    correction = replace(known, lens=found)
    try:
        ideal_camera(next(iter(moving.frames.values())).camera, correction, 0.0)
    except InvalidInputError as error:
        return known, f"{error}; not used"
    return correction, f"{found}, {gain}"


def _with_times(moving: MovingPairs, coarse: MovingPairs, known: CameraCorrection) -> tuple[CameraCorrection, str]:
    """Return `known` with readout time and time offset, if they lower residual and rotation clearly."""
    fit = fit_camera(moving, _with_coarse_readout(coarse, known), fits_lens=False)
    if fit is None:
        return known, "too few pairs of frames can be compared, not used"
    found = replace(
        known,
        readout_s=round(fit.correction.readout_s, 4) + 0.0,
        time_offset_s=round(fit.correction.time_offset_s, 4) + 0.0,
    )
    before, after = moving.error(known), moving.error(found)
    evidence = (
        f"{_milliseconds(found.readout_s, fit.readout_std_s)} and "
        f"{_milliseconds(found.time_offset_s, fit.offset_std_s)}, {after.pairs} pairs of moving "
        f"frames: residual {before.residual:.2f} becomes {after.residual:.2f} of 255, "
        f"rotation error {before.rotation_deg:.2f} becomes {after.rotation_deg:.2f} deg"
    )
    if _is_used(before, after, fit):
        return found, evidence
    return known, f"{evidence}; no clear gain, not used"


def _with_coarse_readout(coarse: MovingPairs, known: CameraCorrection) -> CameraCorrection:
    before = coarse.error(known)
    readout_s = minimum(_READOUTS_S, lambda value: _relative(coarse.error(replace(known, readout_s=value)), before))
    return replace(known, readout_s=readout_s)


def _milliseconds(seconds: float, std_s: float) -> str:
    return f"{1e3 * seconds:.1f} ± {1e3 * std_s:.1f} ms"


def _differs(fit: CameraFit, stds: float, least_s: float) -> bool:
    """Return True if readout time or offset differ from 0 by this many standard errors and this much."""
    times = (
        (fit.correction.readout_s, fit.readout_std_s),
        (fit.correction.time_offset_s, fit.offset_std_s),
    )
    return any(abs(value_s) >= max(stds * std_s, least_s) for value_s, std_s in times)


def _is_used(before: PairError, after: PairError, fit: CameraFit) -> bool:
    """Return True if new times lower both errors, or are clear and lower the rotation, or are certain.

    The pose fit hides a slow camera's readout from the residual: most of it looks like a rotation of the whole image.
    Where the stated poses drift, the rotation that this hides is small beside that of the drift.
    """
    rotation_gain = 1.0 - after.rotation_deg / max(before.rotation_deg, _MIN_ROTATION_DEG)
    residual_gain = 1.0 - after.residual / before.residual
    if _differs(fit, _CERTAIN_STDS, _CERTAIN_TIME_S):
        return rotation_gain >= 0.0 and residual_gain >= -_MAX_RESIDUAL_LOSS
    if rotation_gain < _MIN_MOTION_GAIN:
        return False
    if _differs(fit, _CLEAR_STDS, _CLEAR_TIME_S) and before.rotation_deg >= _CLEAR_ROTATION_DEG:
        return residual_gain >= -_MAX_RESIDUAL_LOSS
    return residual_gain >= _MIN_TIMING_RESIDUAL_GAIN


def _relative(error: PairError, before: PairError) -> float:
    """Return residual and squared rotation relative to those before, added: on few pairs, either alone is flat."""
    return error.residual / before.residual + (error.rotation_deg / max(before.rotation_deg, _MIN_ROTATION_DEG)) ** 2


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
