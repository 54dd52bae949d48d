"""The Kubernetes manifests start the programs with options that exist, on the ports that the services name."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from gausslite_agent.settings import parse_arguments as parse_agent
from gausslite_fusion_server.settings import parse_arguments as parse_fusion_server
from gausslite_parser.program import parse_arguments as parse_parser

MANIFEST = Path(__file__).resolve().parents[2] / "deploy/kubernetes/team.yaml"
PARSERS = {"parser": parse_parser, "fusion-server": parse_fusion_server, "agent": parse_agent}


@pytest.mark.parametrize("name", list(PARSERS))
def test_a_container_runs_its_program_with_valid_options(name: str, tmp_path: Path) -> None:
    documents = list(yaml.safe_load_all(MANIFEST.read_text()))
    (workload,) = (each for each in documents if each["metadata"]["name"] == name and each["kind"] != "Service")
    (service,) = (each for each in documents if each["metadata"]["name"] == name and each["kind"] == "Service")
    pod = workload["spec"]["template"]
    (container,) = pod["spec"]["containers"]
    arguments = [text.replace("$(POD_NAME)", "agent-0").replace("/data", str(tmp_path)) for text in container["args"]]
    settings = PARSERS[name](arguments)
    port = int(settings.listen.rpartition(":")[2])
    ports = [each["containerPort"] for each in container["ports"]]
    assert [each["port"] for each in service["spec"]["ports"]] == ports
    health = settings.health if name == "fusion-server" else settings.listen
    assert ports[0] == port
    for probe in ("readinessProbe", "livenessProbe"):
        assert container[probe]["grpc"]["port"] == int(health.rpartition(":")[2])
    assert service["spec"]["selector"] == workload["spec"]["selector"]["matchLabels"] == pod["metadata"]["labels"]
    if name == "fusion-server":
        assert settings.metrics == "0.0.0.0:9100"
        assert workload["spec"]["replicas"] == 1
