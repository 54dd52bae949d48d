"""Choose the views to train on: first those never trained, newest first, then those trained longest ago.

Uniform draws, as in the paper, leave many views of the window untrained for dozens of iterations, among them new
frames, whose Gaussians need training most (bench/results).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gausslite.domain.errors import MapFileError
from gausslite.domain.state import State, get_array
from gausslite.mapping.window_view import WindowView

_MAX_VIEWS = 256
"""Views whose last visit is kept, those visited last."""


class ViewRotation:
    """The order in which views were last visited. Deterministic: it draws no random numbers."""

    def __init__(self) -> None:
        self._visited: dict[int, None] = {}

    def turns(self, views: Sequence[WindowView]) -> Iterator[WindowView]:
        """Yield these views, which are given oldest first, in turn and without end; each counts as visited."""
        ids = [view.keyframe.frame.id.number for view in views]
        last_visit = {view: place for place, view in enumerate(self._visited)}
        # never visited: -1, so they come first; of these, the newest needs training most
        order = sorted(range(len(views)), key=lambda i: (last_visit.get(ids[i], -1), -i))
        while order:
            for i in order:
                self._visit(ids[i])
                yield views[i]

    def _visit(self, view: int) -> None:
        self._visited.pop(view, None)
        self._visited[view] = None
        if len(self._visited) > _MAX_VIEWS:
            del self._visited[next(iter(self._visited))]

    def state(self) -> State:
        """Return the visited views, the last visit last."""
        return {"views": np.array(list(self._visited), np.int64)}

    def restore(self, state: State) -> None:
        """Continue from another rotation's state. Raises MapFileError."""
        views = get_array(state, "views", (None,), np.int64).tolist()
        if len(views) > _MAX_VIEWS or len(set(views)) < len(views):
            raise MapFileError(f"state views: expected at most {_MAX_VIEWS} different ones, got others")
        self._visited = dict.fromkeys(views)
