"""Robust least squares under a prior: Gauss-Newton's equations, and weights that limit outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

MIN_STD = 0.005
"""Least standard deviation of luminance residuals, in [0, 1]."""
_OUTLIER_STDS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Gauss-Newton's equations of weighted residuals: information · update = gradient."""

    information: Float64[ndarray, "p p"]
    gradient: Float64[ndarray, " p"]

    @classmethod
    def of(
        cls, jacobian: Float64[ndarray, "n p"], residual: Float64[ndarray, " n"], weights: Float64[ndarray, " n"]
    ) -> NormalEquations:
        """Return the equations of the update that minimises |residual + jacobian · update|² with these weights."""
        weighted = jacobian * weights[:, None]
        return cls(weighted.T @ jacobian, -(weighted.T @ residual))

    def plus(self, other: NormalEquations) -> NormalEquations:
        """Return the sum; `other` may depend on the first parameters only."""
        information, gradient, count = self.information.copy(), self.gradient.copy(), len(other.gradient)
        information[:count, :count] += other.information
        gradient[:count] += other.gradient
        return NormalEquations(information, gradient)

    def solve(self, deviation: Float64[ndarray, " p"], prior_std: Float64[ndarray, " p"]) -> Float64[ndarray, " p"]:
        """Return the update for deviation + update ~ N(0, prior_std²).

        deviation: how far the parameters are from the prior's mean before the update.
        """
        # a standard deviation of 0 fixes its parameter up to floating-point precision
        precision = 1.0 / np.square(np.maximum(prior_std, 1e-9))
        information, gradient = self.information + np.diag(precision), self.gradient - precision * deviation
        update: Float64[ndarray, " p"] = np.linalg.solve(information, gradient)
        return update


def robust_std(residual: Float64[ndarray, " n"]) -> float:
    """Return the standard deviation by the median absolute residual."""
    return 1.4826 * float(np.median(np.abs(residual)))


def robust_weights(residual: Float64[ndarray, " n"], min_std: float = MIN_STD) -> Float64[ndarray, " n"]:
    """Return the weights of Geman-McClure, scaled by the robust standard deviation, divided by the variance."""
    return weights_at(residual, max(robust_std(residual), min_std))


def weights_at(residual: Float64[ndarray, " n"], residual_std: float) -> Float64[ndarray, " n"]:
    """Return the weights for a known standard deviation."""
    scaled = residual / residual_std
    weights: Float64[ndarray, " n"] = np.square(1.0 / (1.0 + np.square(scaled / _OUTLIER_STDS))) / residual_std**2
    return weights


def shrinkage(prior_std: float, fit_std: float) -> float:
    """Return the factor by which a fitted change is reduced, in [0, 1].

    Without it, the fits of successive frames would let the map drift.
    """
    return prior_std**2 / (prior_std**2 + fit_std**2)
