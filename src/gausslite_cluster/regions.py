"""Divide a mission among servers: voxels belong to regions, regions to slots, and each slot has one server as owner.

A region is a cube of 4 x 4 x 4 tiles, so that what one robot sends at a time lies in few of them. What a mission knows
of an agent besides its voxels (session, keyframes) belongs to the agent's own slot, its home.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.voxel_changes import hash_columns
from gausslite.domain.voxels import TILE_VOXELS, tiles_of

SLOTS = 256
ALL_SLOTS = frozenset(range(SLOTS))
_REGION_TILES = 4
_AXIS_BITS = 21
# clears the low bits of each axis of a key
_REGION_MASK = sum(((1 << _AXIS_BITS) - _REGION_TILES * TILE_VOXELS) << (axis * _AXIS_BITS) for axis in range(3))


def slots_of(keys: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the slot of each voxel's region, the same in every process."""
    return (hash_columns(tiles_of(keys) & np.int64(_REGION_MASK)) % np.uint64(SLOTS)).astype(np.int64)


def home_slot(agent_id: str) -> int:
    """Return the slot of an agent; its former maps, NAME:EPOCH, have the same."""
    return zlib.crc32(agent_id.partition(":")[0].encode()) % SLOTS


def wanted_slots(servers: Collection[str], server: str) -> frozenset[int]:
    """Return the slots that this one of the live servers should own.

    Each slot goes to the server with the highest hash of both, so that the end of a server moves its slots alone
    (rendezvous hashing: D. Thaler, C. Ravishankar, IEEE/ACM Transactions on Networking 6(1), 1998).
    """
    names = np.array(sorted(zlib.crc32(name.encode()) for name in servers), np.int64)
    own = zlib.crc32(server.encode())
    slots = np.repeat(np.arange(SLOTS, dtype=np.int64), len(names))
    ranks = hash_columns(slots, np.tile(names, SLOTS)).reshape(SLOTS, len(names))
    return frozenset(np.flatnonzero(names[ranks.argmax(axis=1)] == own).tolist())


@dataclass(frozen=True, slots=True)
class Owners:
    """Who serves a mission at a moment: the addresses of the live servers, and the owner of each slot that has one."""

    servers: tuple[str, ...] = ()
    server_of: Mapping[int, str] = field(default_factory=dict)
    # the place of each slot's owner among the servers, one more for none
    _places: Int64[ndarray, " s"] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        places = {server: place for place, server in enumerate(self.servers)}
        found = [places.get(self.server_of.get(slot, ""), len(places)) for slot in range(SLOTS)]
        object.__setattr__(self, "_places", np.array(found, np.int64))

    def home(self, agent_id: str) -> str | None:
        """Return the owner of the agent's slot; None while it has none."""
        return self.server_of.get(home_slot(agent_id))

    @property
    def are_complete(self) -> bool:
        """Whether every slot has an owner."""
        return len(self.server_of) == SLOTS

    def split(self, subset: EncodedSubset) -> list[tuple[str | None, EncodedSubset]]:
        """Return each owner with its part of a message, None with the part for slots without one; at least one."""
        names = (*self.servers, None)
        places = self._places[slots_of(subset.voxels.keys)]
        if len(places) == 0:
            return [(self.home(subset.agent_id), subset)]
        if (places == places[0]).all():
            return [(names[places[0]], subset)]
        return [
            (names[place], replace(subset, voxels=subset.voxels.take(np.flatnonzero(places == place))))
            for place in np.unique(places).tolist()
        ]


@dataclass(frozen=True, slots=True)
class OwnedSlots:
    """The slots of one server."""

    slots: frozenset[int]
    _has: Bool[ndarray, " s"] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_has", np.isin(np.arange(SLOTS), sorted(self.slots)))

    def is_home(self, agent_id: str) -> bool:
        """Return whether the agent's slot is one of them."""
        return home_slot(agent_id) in self.slots

    def have(self, keys: Int64[ndarray, " n"]) -> bool:
        """Return whether all of these voxels are in them."""
        return bool(self._has[slots_of(keys)].all())
