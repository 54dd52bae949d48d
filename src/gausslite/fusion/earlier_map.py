"""Keep the map of an agent that begins a new one: its earlier map stays in the vote until it is outgrown.

An agent has at most two maps in the store: its own, and one merged from all before it. The earlier map is in the fused
frame and a source of the vote like any agent, so the agent's updates and tombstones do not change it. It wins a voxel
until the agent's own Σkappa is higher. It is deleted when it wins no voxel.
"""

from __future__ import annotations

# no agent can join under such a name, because ids of agents hold no colon
_EARLIER_SUFFIX = ":earlier"


def earlier_map_of(agent_id: str) -> str:
    """Return the name under which the agent's earlier map takes part in the vote."""
    return agent_id + _EARLIER_SUFFIX


def is_earlier_map(name: str) -> bool:
    """Return whether this is the name of an earlier map instead of an agent."""
    return name.endswith(_EARLIER_SUFFIX)
