"""Measure whether the task's region still improves, and release the iterations that it does not use.

The loss of an active iteration is compared with that of the previous one on the same view, so that easy and hard views
do not mix. The improvement per visit starts above 0.1 in a new region and falls where views contradict each other. On
real cameras, released iterations cost the region nothing. The rest of the image gains 1 to 6 dB, and poses are fitted
to all of it (bench/results).
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np

from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.state import State, get_array, get_counts, get_floats, int_array

_HORIZON_VISITS = 32
"""Visits behind the running mean; before that many, the region counts as improving."""
_MAX_CHANGE = 0.3
"""Bound of one visit's change of the log loss: a refined pose may change the loss of a view at once."""
_MAX_VIEWS = 256
"""Views whose last loss is kept, those visited last."""


@dataclass(frozen=True, slots=True)
class SaturationSettings:
    """Release of active iterations to whole images.

    max_released: largest share of the active iterations that is released; 0 disables the release. The rest keeps
    measuring the region. improving, saturated: mean decreases of the log loss per visit of a view. No iteration is
    released from `improving` upwards, and max_released from `saturated` downwards. Between them the share is linear.
    """

    max_released: float = 0.75
    improving: float = 0.12
    saturated: float = 0.04

    def __post_init__(self) -> None:
        if not 0 <= self.max_released <= 1:
            raise InvalidInputError(f"saturation max_released: expected 0 to 1, got {self.max_released}")
        if not -math.inf < self.saturated < self.improving < math.inf:
            raise InvalidInputError(
                f"saturation saturated: expected less than improving ({self.improving}), got {self.saturated}"
            )


class RegionSaturation:
    """Running mean of the region's improvement per visit of a view. Deterministic: it draws no random numbers."""

    def __init__(self, settings: SaturationSettings) -> None:
        self._settings = settings
        self.reset()

    @property
    def enabled(self) -> bool:
        """False if no iteration is ever released; then reading the loss, which may wait for a device, is not needed."""
        return self._settings.max_released > 0

    def reset(self) -> None:
        """Forget all measurements: a new task has another region."""
        self._last_loss: dict[int, float] = {}
        self._improvement, self._visits, self._credit = 0.0, 0, 0.0

    @property
    def released_share(self) -> float:
        """Share of the active iterations to run on whole images instead, in [0, max_released]."""
        settings = self._settings
        if self._visits < _HORIZON_VISITS:
            return 0.0
        share = (settings.improving - self._improvement) / (settings.improving - settings.saturated)
        return min(max(share, 0.0), 1.0) * settings.max_released

    def observe(self, recorded: Frame, loss: float) -> None:
        """Compare the loss of an active iteration with the previous one on the view of this recorded frame."""
        if not 0.0 < loss < math.inf:
            return
        view = _view_id(recorded)
        previous = self._last_loss.pop(view, None)
        self._last_loss[view] = loss
        if len(self._last_loss) > _MAX_VIEWS:
            del self._last_loss[next(iter(self._last_loss))]
        if previous is not None:
            change = min(max(math.log(previous / loss), -_MAX_CHANGE), _MAX_CHANGE)
            self._visits = min(self._visits + 1, _HORIZON_VISITS)
            self._improvement += (change - self._improvement) / self._visits

    def releases_next(self) -> bool:
        """True if the next active iteration is released. Call it once per active iteration; shares add up exactly."""
        self._credit += self.released_share
        released = self._credit >= 1.0
        self._credit -= float(released)
        return released

    def state(self) -> State:
        """Return the last losses, in the order of the visits, and the running mean."""
        return {
            "views": int_array(*self._last_loss),
            "losses": np.array(list(self._last_loss.values()), np.float64),
            "mean": np.array([self._improvement, self._credit]),
            "visits": int_array(self._visits),
        }

    def restore(self, state: State) -> None:
        """Continue from another measurement's state. Raises MapFileError."""
        views = get_array(state, "views", (None,), np.int64)
        losses = get_floats(state, "losses", len(views))
        if len(views) > _MAX_VIEWS or not all(loss > 0 for loss in losses):
            raise MapFileError(f"state saturation: expected at most {_MAX_VIEWS} losses above 0, got others")
        self._last_loss = dict(zip(views.tolist(), losses, strict=True))
        self._improvement, self._credit = get_floats(state, "mean", 2)
        [self._visits] = get_counts(state, "visits", 1)


def _view_id(recorded: Frame) -> int:
    """Return a number that identifies a recorded frame also after a restart, without its time: clocks may restart."""
    pose = zlib.crc32(np.ascontiguousarray(recorded.T_world_camera).tobytes())
    return (recorded.index & 0x7FFFFFFF) << 32 | pose
