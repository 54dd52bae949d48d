"""Estimate how far the poses and exposures of a recording are off.

Errors come from pairs of frames that show the same surfaces. One frame is warped into the other by its depth and
both poses. The pair is as far apart in time as the overlap allows. The other frame's pose and exposure are then fitted
to the warped image, as they would be to a rendered map. With exact poses and fixed exposure the fit changes nothing;
otherwise it yields the combined error of both views.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy import ndarray

from gausslite.datasets.source import Source, capped_size
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, twist_of
from gausslite.domain.recording import HANDHELD_PRIOR, PoseExposurePrior
from gausslite.render.rasterizer import Rendering
from gausslite_calibration.corrected import CorrectedSource
from gausslite_calibration.moving_pairs import warp_into
from gausslite_poses.exposure import fit_exposure
from gausslite_poses.photometric import comparable_pixels, fit_pose

_MAX_PAIRS = 24
_MIN_PAIRS = 4
_MIN_PIXELS = 2000
"""About a quarter of the compared pixels; with less overlap the pose fit is unreliable."""
_EXACT_M, _EXACT_DEG = 0.003, 0.1
"""Estimates up to these count as exact: for exact poses of simulated homes they reach 2 mm and 0.05 degrees."""


def estimate_pose_exposure_prior(source: Source) -> tuple[PoseExposurePrior, str]:
    """Return the prior of the source's views and the reason. The prior is exact if the pose error is insignificant.

    Unreadable frames are ignored here; mapping reports them.
    """
    twists, gains, offsets = [], [], []
    # frames are compared with each other, so a rolling shutter is removed from their images
    images = source.rectified() if isinstance(source, CorrectedSource) else source
    for warped, frame in _pairs(images):
        T_world_fitted = fit_pose(warped, inverse(frame.T_world_camera), frame, HANDHELD_PRIOR)
        exposure = fit_exposure(warped, frame, HANDHELD_PRIOR)
        twists.append(twist_of(inverse(frame.T_world_camera) @ T_world_fitted))
        gains.append(exposure.gain - 1.0)
        offsets.append(exposure.offset)
    if len(twists) < _MIN_PAIRS:
        return PoseExposurePrior(), f"only {len(twists)} pairs of frames overlap, too few for an estimate"
    errors = np.array(twists)
    prior = PoseExposurePrior(
        translation_m=round(_std_per_view(errors[:, :3]), 3),
        rotation_deg=round(math.degrees(_std_per_view(errors[:, 3:])), 2),
        gain=round(_std_per_view(np.array(gains)), 2),
        offset=round(_std_per_view(np.array(offsets)), 2),
    )
    reason = f"{len(twists)} pairs of frames agree to {1e3 * prior.translation_m:.0f} mm, {prior.rotation_deg:g} deg"
    is_exact = prior.translation_m <= _EXACT_M and prior.rotation_deg <= _EXACT_DEG
    return (PoseExposurePrior() if is_exact else prior), reason


def _std_per_view(pair_errors: ndarray) -> float:
    """Return the standard deviation of one view's error, robustly, from errors between two views."""
    return float(1.4826 * np.median(np.abs(pair_errors)) / math.sqrt(2.0))


def _pairs(source: Source) -> Iterator[tuple[Rendering, Frame]]:
    """Yield frames, each with another one warped into its view, spread over the source and far apart in time."""
    count, size = len(source), capped_size(source.camera)
    last_gap = count // 4
    for position in sorted({round(position) for position in np.linspace(0, count - 1, _MAX_PAIRS)}):
        direction = 1 if position < count // 2 else -1
        gap = min(2 * last_gap, count // 2)
        first: Frame | None = None
        while gap >= 1:
            try:
                first = first or source.frame(position, size)
                second = source.frame(position + direction * gap, size)
            except (DatasetError, PoseError):
                break
            warped = warp_into(first, second)
            if len(comparable_pixels(warped, second)) >= _MIN_PIXELS:
                yield warped, second
                last_gap = gap
                break
            gap //= 2
