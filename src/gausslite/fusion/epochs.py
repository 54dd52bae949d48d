"""The maps of an agent: the present one, and former ones that stay in the vote until it has outgrown them.

A robot that begins a new map begins another epoch of its data. Its present map has the agent's name, a former one
NAME:EPOCH, under which it takes part in the vote like any agent, so the agent's updates and tombstones do not change
it. A former map leaves the store, in slices, when it wins no voxel, or is not used, or the agent has too many.
"""

from __future__ import annotations

from collections.abc import Mapping

from gausslite.domain.errors import CodecError

RECORD = "epoch"
MAX_FORMER_MAPS = 7
"""Of one agent; of more, those that win the fewest voxels leave."""


def agent_of(name: str) -> str:
    """Return the agent of a map."""
    return name.partition(":")[0]


def is_former(name: str) -> bool:
    """Return whether this is the name of a former map; ids of agents hold no colon."""
    return ":" in name


class Epochs:
    """The present epoch of each agent. Rows have the label of their map, which never changes, as names do."""

    def __init__(self) -> None:
        self._epochs: dict[str, int] = {}

    def load(self, records: Mapping[str, bytes]) -> None:
        """Read the records of all agents. Raises CodecError."""
        try:
            self._epochs |= {agent_id: int(data) for agent_id, data in records.items()}
        except ValueError as error:
            raise CodecError(f"stored epoch: expected a number, got other bytes ({error})") from error

    def set(self, agent_id: str, epoch: int) -> None:
        """Set the epoch of the agent's present map; 0 for its first one."""
        self._epochs[agent_id] = epoch
        if epoch == 0:
            del self._epochs[agent_id]

    def former_name(self, agent_id: str) -> str:
        """Return the name that the agent's present map has when another one begins."""
        return f"{agent_id}:{self._epochs.get(agent_id, 0)}"

    def label_of(self, name: str) -> str:
        """Return the label of a map's rows."""
        former = name if is_former(name) else self.former_name(name)
        return former.removesuffix(":0")

    def name_of(self, label: str) -> str:
        """Return the name of the map with this label."""
        agent_id, former = agent_of(label), label if is_former(label) else f"{label}:0"
        return agent_id if former == self.former_name(agent_id) else former
