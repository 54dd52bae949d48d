"""Record at which revision of a map each voxel last changed."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import RevisionGoneError

MAX_REMOVED_VOXELS = 100_000


class RevisionLog:
    """Records the last change of every voxel of a map, so that a watcher can get the changes that it has missed.

    The log has one entry for each voxel of the map, plus the latest `max_removed` voxels that became empty. A watcher
    that misses an older removal has to begin with a snapshot. `first_revision` must exceed all revisions from before a
    restart.
    """

    def __init__(self, first_revision: int, max_removed: int = MAX_REMOVED_VOXELS) -> None:
        self._revision = self._oldest = first_revision
        self._max_removed = max_removed
        # both in the order of the revisions, so that changed_since reads only what changed
        self._changed_at: dict[int, int] = {}
        self._removed_at: OrderedDict[int, int] = OrderedDict()

    @property
    def revision(self) -> int:
        """The map's current revision."""
        return self._revision

    def record(self, changed: Iterable[int], removed: Iterable[int], revision: int) -> None:
        """Set the current revision, at which these voxels changed or became empty."""
        self._revision = revision
        for key in changed:
            self._removed_at.pop(key, None)
            self._changed_at.pop(key, None)
            self._changed_at[key] = revision
        for key in removed:
            del self._changed_at[key]
            self._removed_at[key] = revision
            if len(self._removed_at) > self._max_removed:
                _, dropped_revision = self._removed_at.popitem(last=False)
                self._oldest = max(self._oldest, dropped_revision)

    def changed_at(self, key: int) -> int:
        """Return the revision at which a voxel of the map last changed; 0 if it is not in the map."""
        return self._changed_at.get(key, 0)

    def changed_since(self, revision: int) -> Int64[ndarray, " c"]:
        """Return the keys of the voxels that changed or became empty after this revision, ascending.

        Raises RevisionGoneError if the revision is from before a restart, or older than a removal no longer recorded.
        """
        if not self._oldest <= revision <= self._revision:
            raise RevisionGoneError(
                f"since_revision: expected {self._oldest} to {self._revision}, or 0 for a snapshot, got {revision}"
            )
        recent = [*_keys_after(self._changed_at, revision), *_keys_after(self._removed_at, revision)]
        return np.sort(np.array(recent, np.int64))


def _keys_after(revisions: dict[int, int], revision: int) -> Iterator[int]:
    return itertools.takewhile(lambda key: revisions[key] > revision, reversed(revisions))
