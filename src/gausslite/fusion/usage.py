"""Count what the store keeps of each agent, and refuse messages that exceed its quotas."""

from __future__ import annotations

import numpy as np

from gausslite.domain.voxel_batch import RoiSubset
from gausslite.fusion.limits import AgentUsage, Quotas
from gausslite.fusion.store import FusionStore, VoxelScoreTable


class UsageLedger:
    """The usage of each agent with updates. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, scores: VoxelScoreTable, quotas: Quotas) -> None:
        self._quotas = quotas
        self._usage = {agent_id: AgentUsage.from_scores(scores, agent_id) for agent_id in scores.agents}

    @property
    def agents(self) -> frozenset[str]:
        """The agents with updates."""
        return frozenset(self._usage)

    def after(self, subset: RoiSubset, store: FusionStore) -> AgentUsage:
        """Return the agent's usage after this message is stored. Raises QuotaError."""
        batch = subset.batch
        scores = store.scores(batch.keys)
        agent_index = scores.agents.index(subset.agent_id) if subset.agent_id in scores.agents else -1
        own = scores.agent_index == agent_index
        newer_keys = scores.keys[own & (scores.update_seqs >= subset.update_seq)]
        accepted = ~np.isin(batch.keys, newer_keys)
        replaced = own & np.isin(scores.keys, batch.keys[accepted])
        removed = AgentUsage(int(np.count_nonzero(replaced)), int(scores.counts[replaced].sum(dtype=np.int64)))
        added = AgentUsage(int(np.count_nonzero(accepted)), int(batch.counts[accepted].sum(dtype=np.int64)))
        usage = self.get(subset.agent_id).replace_part(removed, added)
        usage.require_within(self._quotas, subset.agent_id)
        return usage

    def get(self, agent_id: str) -> AgentUsage:
        """Return the usage of an agent; zero for an unknown one."""
        return self._usage.get(agent_id, AgentUsage())

    def set(self, agent_id: str, usage: AgentUsage) -> None:
        """Store the usage of an agent."""
        self._usage[agent_id] = usage

    def remove_agent(self, agent_id: str) -> None:
        """Delete the usage of an agent."""
        self._usage.pop(agent_id, None)
