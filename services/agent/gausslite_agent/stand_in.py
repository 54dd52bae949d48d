"""The sequence that stands in for the robot's camera, opened while the agent already answers if that takes long."""

from __future__ import annotations

import threading

from gausslite.datasets.open import is_simulated, open_source
from gausslite.datasets.source import Source
from gausslite.domain.pose import UpAxis
from gausslite_agent.settings import PlaySettings


class StandIn:
    """Opens a sequence once, whoever asks first; the others wait for it.

    A folder is opened here and now, so that a wrong path is told before anything is served. A simulated home takes
    seconds to build and waits for the first `source`.
    """

    def __init__(self, play: PlaySettings, up_axis: UpAxis | None) -> None:
        """Raises DatasetError and the like for a folder."""
        self.play = play
        self._up_axis = up_axis
        self._opening = threading.Lock()
        self._source: Source | None = None
        if not is_simulated(play.source):
            self.source()

    def source(self) -> Source:
        """The opened sequence. Raises what opening raises, every time."""
        with self._opening:
            if self._source is None:
                self._source = open_source(self.play.source, self._up_axis, self.play.colour_camera)
            return self._source
