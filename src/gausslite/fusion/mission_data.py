"""The data of one mission, opened on one store."""

from __future__ import annotations

from dataclasses import dataclass
from threading import RLock

from gausslite.fusion.agent_data import AgentData
from gausslite.fusion.alignment import Fit
from gausslite.fusion.frame_aligner import FrameAligner
from gausslite.fusion.frames import FrameAlignments
from gausslite.fusion.fused_map import FusedMapLayers, load_refinement
from gausslite.fusion.keyframes import FrameDecoder, KeyframePool
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.membership import Membership
from gausslite.fusion.mission_clock import MissionClock
from gausslite.fusion.objects import TeamObjects
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_values import SharedRows
from gausslite.fusion.traffic import AgentContribution, MissionStatus, TrafficLog
from gausslite.fusion.unknown_frames import Find, UnknownFrames
from gausslite.fusion.updates import UpdateChecks
from gausslite.fusion.vote_input import VoteInput


@dataclass(frozen=True, slots=True, eq=False)
class MissionData:
    """Each member reads its data from the store when it is opened. FusionEngine guards them with one lock."""

    members: Membership
    keyframes: KeyframePool
    objects: TeamObjects
    checks: UpdateChecks
    traffic: TrafficLog
    alignments: FrameAlignments
    votes: VoteInput
    aligner: FrameAligner
    unknown_frames: UnknownFrames
    maps: FusedMapLayers
    agents: AgentData

    @classmethod
    def open(
        cls,
        store: FusionStore,
        settings: FusionSettings,
        lock: RLock,
        first_revision: int,
        decode: FrameDecoder,
        comparisons: tuple[Fit, Find],
        others: SharedRows | None = None,
    ) -> MissionData:
        """Read the data; others: of the servers that share the store.

        Raises MismatchError, CodecError for damaged records, StorageError.
        """
        grid, quotas = settings.grid, settings.quotas
        members = Membership(store, settings, others)
        keyframes = KeyframePool(store, quotas.keyframe_limits, decode)
        objects, checks = TeamObjects(store), UpdateChecks(store, quotas, MissionClock(store), others)
        traffic = TrafficLog(store)
        alignments = FrameAlignments(store)
        votes = VoteInput(store, alignments, grid)
        aligner = FrameAligner(store, alignments, lock, grid, settings.alignment, comparisons[0])
        # a refinement is of the whole map
        refined = load_refinement(store) if others is None else None
        maps = FusedMapLayers(votes, lock, grid, first_revision, settings.max_removed_voxels, refined)
        of_agents = members.sessions, checks, traffic, keyframes, objects
        return cls(
            members=members,
            keyframes=keyframes,
            objects=objects,
            checks=checks,
            traffic=traffic,
            alignments=alignments,
            votes=votes,
            aligner=aligner,
            unknown_frames=UnknownFrames(store, alignments, aligner, keyframes, lock, comparisons[1]),
            maps=maps,
            agents=AgentData(store, votes, maps, alignments, aligner, of_agents),
        )

    def status(self, store: FusionStore) -> MissionStatus:
        """Return the totals of the mission and of each agent. Call it with the engine's lock."""
        fused_voxels, fused_gaussians = self.maps.size()
        return MissionStatus(
            mission_config=self.members.mission_config,
            revision=self.maps.revision(),
            fused_gaussians=fused_gaussians,
            fused_voxels=fused_voxels,
            keyframes=len(self.keyframes),
            refined=self.maps.is_refined,
            agents=tuple(self._contribution(store, agent_id) for agent_id in sorted(self.members.sources)),
            banned_agents=self.members.bans.agents,
        )

    def _contribution(self, store: FusionStore, agent_id: str) -> AgentContribution:
        totals = store.totals(agent_id)
        return AgentContribution(
            agent_id,
            joined=agent_id in self.members.sessions.agents,
            voxels=totals.occupied_voxels,
            gaussians=totals.gaussians,
            kappa_sum=totals.kappa_sum,
            won_voxels=self.maps.won_voxels(agent_id),
            last_update_seq=totals.highest_update_seq,
            keyframes=self.keyframes.count(agent_id),
            targets=self.objects.targets(agent_id),
            alignment=self.alignments.get(agent_id),
            traffic=self.traffic.of(agent_id),
        )
