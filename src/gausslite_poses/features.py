"""Match features of two frames, and find the motion between their cameras from the matches and measured depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, lift
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import orthonormal
from gausslite.domain.state import State, get_array

_MAX_FEATURES = 500
_FAST_THRESHOLD = 7
"""Lower than OpenCV's 20, for images that a moving camera blurs."""
_MAX_HAMMING = 64
"""Largest distance of matching descriptors, of 256 bits."""
_MAX_REPROJECTION_PX = 2.0
_RANSAC_ITERATIONS = 100
MIN_INLIERS = 12


@dataclass(frozen=True, slots=True, eq=False)
class FeatureView:
    """Features of one frame with a depth reading or without; pixel centres are at integers, as in OpenCV.

    points_m: in the camera's frame; z is 0 without a depth reading.
    """

    pixels: Float32[ndarray, "n 2"]
    points_m: Float32[ndarray, "n 3"]
    descriptors: UInt8[ndarray, "n 32"]

    def __post_init__(self) -> None:
        count = len(self.pixels)
        require_array("features pixels", self.pixels, (count, 2), np.float32)
        require_array("features points_m", self.points_m, (count, 3), np.float32)
        require_array("features descriptors", self.descriptors, (count, 32), np.uint8)

    def state(self) -> State:
        """Return the features as named arrays."""
        return {"pixels": self.pixels, "points_m": self.points_m, "descriptors": self.descriptors}

    @classmethod
    def from_state(cls, state: State) -> FeatureView:
        """Return a copy of the features that `state` described. Raises MapFileError."""
        pixels = get_array(state, "pixels", (None, 2), np.float32)
        points_m = get_array(state, "points_m", (len(pixels), 3), np.float32)
        if not (np.isfinite(pixels).all() and np.isfinite(points_m).all()):
            raise MapFileError("state features: expected finite numbers, got NaN or infinity")
        descriptors = get_array(state, "descriptors", (len(pixels), 32), np.uint8)
        return cls(pixels.copy(), points_m.copy(), descriptors.copy())


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """T_current_reference from matched features, and the number of matches that agree with it.

    points_m: of these matches, in the reference's camera. reference_px, pixels: their places in both images.
    """

    T_current_reference: Float64[ndarray, "4 4"]
    points_m: Float64[ndarray, "n 3"]
    reference_px: Float64[ndarray, "n 2"]
    pixels: Float64[ndarray, "n 2"]

    @property
    def inliers(self) -> int:
        """Number of matches that agree with the pose."""
        return len(self.pixels)


def detect_features(frame: Frame) -> FeatureView:
    """Return the frame's ORB features."""
    camera = frame.camera
    orb = cv2.ORB.create(nfeatures=_MAX_FEATURES, nlevels=6, fastThreshold=_FAST_THRESHOLD)
    keypoints, descriptors = orb.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), None)
    if not keypoints:
        return FeatureView(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8))
    pixels = np.array(cv2.KeyPoint.convert(keypoints)).astype(np.float32).reshape(-1, 2)
    columns = np.clip(np.rint(pixels[:, 0]).astype(np.int64), 0, camera.width_px - 1)
    rows = np.clip(np.rint(pixels[:, 1]).astype(np.int64), 0, camera.height_px - 1)
    z_m = frame.depth_m[rows, columns]
    return FeatureView(pixels, lift(pixels + np.float32(0.5), z_m, camera), descriptors)


def relative_pose(reference: FeatureView, current: FeatureView, camera: Camera) -> RelativePose | None:
    """Return the current camera's pose relative to the reference's, by PnP with RANSAC; None with too few inliers.

    The 3D points are the reference's. OpenCV's random numbers have a fixed seed, so equal inputs give equal poses.
    """
    with_depth = np.flatnonzero(reference.points_m[:, 2] > 0)
    if min(len(with_depth), len(current.pixels)) < MIN_INLIERS:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(reference.descriptors[with_depth], current.descriptors)
    close = [match for match in matches if match.distance <= _MAX_HAMMING]
    if len(close) < MIN_INLIERS:
        return None
    matched = with_depth[[match.queryIdx for match in close]]
    points = reference.points_m[matched].astype(np.float64)
    pixels = current.pixels[[match.trainIdx for match in close]].astype(np.float64)
    found, rotation_rad, translation_m, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        camera.opencv_matrix,
        None,
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=_MAX_REPROJECTION_PX,
    )
    if not found or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation_rad)[0], translation_m.ravel()
    if not np.isfinite(T).all():
        return None
    agreeing = inliers.ravel()
    reference_px = reference.pixels[matched[agreeing]].astype(np.float64)
    return RelativePose(orthonormal(T), points[agreeing], reference_px, pixels[agreeing])
