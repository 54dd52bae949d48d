"""The figures that Prometheus reads over HTTP."""

import json
import re
import urllib.request
from pathlib import Path

import pytest
from fusion_running import GRID, make_subset

from gausslite.domain.errors import InvalidInputError, UnavailableError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.traffic import TrafficCounters

pytest.importorskip("prometheus_client", reason="the extra metrics is not installed")

from prometheus_client.parser import text_string_to_metric_families

from gausslite_operations.metrics import metrics_server

ROOT = Path(__file__).resolve().parents[2]
ANYTHING = MissionConfig("", "", GRID.size_m)


@pytest.fixture
def engine() -> FusionEngine:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID))
    for agent_id, kappa in (("ant", 1), ("bee", 2)):
        session = engine.join(agent_id, ANYTHING).session.session_id
        engine.contribute(session, make_subset(agent_id, 1, {0: [kappa], 1: [3 - kappa], 2: [kappa]}), GRID)
    engine.traffic.record("bee", TrafficCounters(roi_bytes=5000, subsets_rejected=7, localisation=3))
    return engine


def read(port: int) -> dict[tuple[str, str], float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as response:
        text = response.read().decode()
    return {
        (sample.name, sample.labels.get("agent", "")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_prometheus_reads_the_mission_and_each_agent(engine: FusionEngine) -> None:
    with metrics_server("127.0.0.1:0", lambda: engine, engine.acknowledgements) as port:
        values = read(port)
        assert values["gausslite_fusion_fused_voxels", ""] == 3
        assert values["gausslite_agent_won_voxels", "ant"] == 1
        assert values["gausslite_agent_won_voxels", "bee"] == 2
        assert values["gausslite_agent_joined", "ant"] == 1
        assert values["gausslite_agent_localisation", "bee"] == 3
        assert values["gausslite_agent_roi_bytes_total", "bee"] == 5000
        assert values["gausslite_agent_subsets_rejected_total", "bee"] == 7
        assert values["gausslite_fusion_acknowledgement_seconds_count", ""] == 2
        assert values["process_resident_memory_bytes", ""] > 1e6
        engine.evict("bee", ban=True)
        values = read(port)
        assert values["gausslite_fusion_banned_agents", ""] == 1
        assert ("gausslite_agent_won_voxels", "bee") not in values


def test_the_dashboard_shows_metrics_that_exist(engine: FusionEngine) -> None:
    dashboard = json.loads((ROOT / "deploy/grafana_dashboard.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    used = {name for query in queries for name in re.findall(r"(?:gausslite|process)_\w+", query)}
    with metrics_server("127.0.0.1:0", lambda: engine, engine.acknowledgements) as port:
        served = {name for name, _ in read(port)}
    assert len(used) >= 8
    assert used <= served


def test_wrong_addresses_are_one_line(engine: FusionEngine) -> None:
    with pytest.raises(InvalidInputError, match="--metrics: expected HOST:PORT"):
        metrics_server("9100", lambda: engine, engine.acknowledgements).__enter__()
    with metrics_server("127.0.0.1:0", lambda: engine, engine.acknowledgements) as port:
        second = metrics_server(f"127.0.0.1:{port}", lambda: engine, engine.acknowledgements)
        pytest.raises(UnavailableError, second.__enter__).match("choose another address")
