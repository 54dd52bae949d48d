"""Serve the figures of a mission to Prometheus over HTTP, for `--metrics` (the extra metrics)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import accumulate
from typing import Any

from gausslite.domain.errors import UnavailableError
from gausslite.fusion.traffic import ACKNOWLEDGEMENT_BOUNDS_S, Acknowledgements, AgentContribution, MissionStatus
from gausslite.process import import_extra
from gausslite.wire.channel import host_and_port
from gausslite_fusion_server.plugins import FindCounts, FindEngine

_log = logging.getLogger(__name__)


_OF_AGENTS: tuple[tuple[str, str, Callable[[AgentContribution], float]], ...] = (
    ("joined", "1 while the agent has a session", lambda each: each.joined),
    ("voxels", "voxels that the agent has contributed", lambda each: each.voxels),
    ("gaussians", "Gaussians that the agent has contributed", lambda each: each.gaussians),
    ("won_voxels", "voxels of the fused map that the agent won", lambda each: each.won_voxels),
    ("keyframes", "stored keyframes of the agent", lambda each: each.keyframes),
    ("last_seen_seconds", "time of the last message since the epoch", lambda each: each.traffic.last_seen_ns / 1e9),
    ("localisation", "1 tracked, 2 doubtful, 3 lost, 0 before the agent says", lambda each: each.traffic.localisation),
)
_COUNTERS_OF_AGENTS: tuple[tuple[str, str, Callable[[AgentContribution], float]], ...] = (
    ("roi_bytes", "received bytes of the task's region", lambda each: each.traffic.roi_bytes),
    ("handover_bytes", "received bytes of handovers", lambda each: each.traffic.handover_bytes),
    ("subsets_accepted", "messages stored", lambda each: each.traffic.subsets_accepted),
    ("subsets_stale", "messages without news", lambda each: each.traffic.subsets_stale),
    ("subsets_rejected", "messages refused", lambda each: each.traffic.subsets_rejected),
)
_OF_MISSION: tuple[tuple[str, str, Callable[[MissionStatus, bool], float]], ...] = (
    ("revision", "revision of the fused map", lambda status, _: status.revision),
    ("fused_voxels", "voxels of the fused map", lambda status, _: status.fused_voxels),
    ("fused_gaussians", "Gaussians of the fused map", lambda status, _: status.fused_gaussians),
    ("stored_keyframes", "keyframes of all agents", lambda status, _: status.keyframes),
    ("store_writable", "1 while the store can write", lambda _, is_writable: is_writable),
    ("banned_agents", "names that operators have banned", lambda status, _: len(status.banned_agents)),
)


_OF_SHARE = (
    ("messages_received", "messages that agents sent to this server"),
    ("parts_sent", "parts of them sent to other servers, which own their voxels"),
    ("parts_stored", "parts of messages stored as the owner of their voxels"),
    ("parts_foreign", "parts of messages refused, because this server does not own their voxels"),
)


class MissionCollector:
    """Reads the figures when Prometheus asks for them; counters start at 0 with the server."""

    def __init__(self, engine: FindEngine, acknowledgements: Acknowledgements, counts: FindCounts | None) -> None:
        self._engine, self._acknowledgements, self._counts = engine, acknowledgements, counts

    def collect(self) -> Iterator[Any]:
        """Yield the metrics of the mission and of each agent, with the ids as the labels `mission` and `agent`."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

        engine = self._engine()
        status, is_writable = engine.status(), engine.storage.is_writable
        mission_id = status.mission_config.mission_id
        for name, help_text, value in _OF_MISSION:
            of_mission = GaugeMetricFamily(f"gausslite_fusion_{name}", help_text, labels=["mission"])
            of_mission.add_metric([mission_id], value(status, is_writable))
            yield of_mission
        counts, total_s = self._acknowledgements.histogram()
        bounds = [*map(str, ACKNOWLEDGEMENT_BOUNDS_S), "+Inf"]
        acknowledgement = HistogramMetricFamily(
            "gausslite_fusion_acknowledgement_seconds", "time from a message to its answer", labels=["mission"]
        )
        acknowledgement.add_metric([mission_id], list(zip(bounds, accumulate(counts), strict=True)), total_s)
        yield acknowledgement
        if self._counts is not None:
            for (name, help_text), count in zip(_OF_SHARE, self._counts(), strict=True):
                of_share = CounterMetricFamily(f"gausslite_fusion_{name}", help_text, labels=["mission"])
                of_share.add_metric([mission_id], count)
                yield of_share
        for kind, metrics in ((GaugeMetricFamily, _OF_AGENTS), (CounterMetricFamily, _COUNTERS_OF_AGENTS)):
            for name, help_text, of_agent in metrics:
                family = kind(f"gausslite_agent_{name}", help_text, labels=["mission", "agent"])
                for agent in status.agents:
                    family.add_metric([mission_id, agent.agent_id], of_agent(agent))
                yield family


@contextmanager
def metrics_server(
    address: str, engine: FindEngine, acknowledgements: Acknowledgements, counts: FindCounts | None = None
) -> Iterator[int]:
    """Serve /metrics on HOST:PORT while the context is open, with the figures of the process; gives the actual port.

    engine: returns the mission, or this server's part of it.
    Raises InvalidInputError without prometheus-client or for another address, UnavailableError if it is in use.
    """
    host, port = host_and_port("--metrics", address)
    prometheus = import_extra("prometheus_client", "metrics", "--metrics")
    registry = prometheus.CollectorRegistry()
    prometheus.ProcessCollector(registry=registry)
    registry.register(MissionCollector(engine, acknowledgements, counts))
    try:
        server, thread = prometheus.start_http_server(port, host.strip("[]"), registry)
    except OSError as error:
        raise UnavailableError(f"--metrics {address}: {error.strerror or error}; choose another address") from error
    _log.info("metrics on http://%s:%d/metrics", host, server.server_port)
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
