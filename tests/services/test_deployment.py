"""deploy/: pinned images that no public registry answers, programs with options that exist, pods that are closed."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from certificates import make_certificates
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gausslite_agent.settings import parse_arguments as parse_agent
from gausslite_fusion_server.settings import parse_arguments as parse_fusion_server
from gausslite_parser.program import parse_arguments as parse_parser

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
EXTRAS = ("sim", "metrics", "postgres", "grounding", "llm")
PARSERS: Any = {"parser": parse_parser, "fusion-server": parse_fusion_server, "agent": parse_agent}
HARDENED = {"readOnlyRootFilesystem": True, "allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}


def manifest(name: str, *kinds: str) -> Any:
    paths = (DEPLOY / "kubernetes/team.yaml", DEPLOY / "kubernetes/network_policies.yaml")
    documents = [each for path in paths for each in yaml.safe_load_all(path.read_text())]
    (found,) = (each for each in documents if each["metadata"]["name"] == name and each["kind"] in kinds)
    return found["spec"]


def workload(name: str) -> Any:
    return manifest(name, "Deployment", "StatefulSet")


@pytest.mark.parametrize("name", list(PARSERS))
def test_a_pod_runs_its_program_with_certificates_and_probes_it(name: str, tmp_path: Path) -> None:
    own = make_certificates(tmp_path / "made", "agent-0") / "agent-0"
    (container,) = workload(name)["template"]["spec"]["containers"]
    on_this_machine = {"$(POD_NAME)": "agent-0", "/data": str(tmp_path), "/certs": str(own)}
    arguments = container["args"]
    for text, replacement in on_this_machine.items():
        arguments = [argument.replace(text, replacement) for argument in arguments]
    settings = PARSERS[name](arguments)
    assert settings.tls.authorities is not None
    port = settings.listen.rpartition(":")[2]
    ports = [each["containerPort"] for each in container["ports"]]
    assert [each["port"] for each in manifest(name, "Service")["ports"]] == ports
    assert ports[0] == int(port)
    for kind in ("startupProbe", "readinessProbe", "livenessProbe"):
        if name == "fusion-server":
            assert container[kind]["grpc"]["port"] == int(settings.health.rpartition(":")[2])
        else:
            words = container[kind]["exec"]["command"]
            assert words[:4] == ["python", "-m", "gausslite.cli.health_check", f"127.0.0.1:{port}"]
            assert ("liveness" in words) == (kind == "livenessProbe")
    labels = workload(name)["template"]["metadata"]["labels"]
    assert manifest(name, "Service")["selector"] == workload(name)["selector"]["matchLabels"] == labels
    if name == "fusion-server":
        assert settings.metrics == "0.0.0.0:9100"
        assert workload(name)["replicas"] == 1


@pytest.mark.parametrize("name", list(PARSERS))
def test_a_pod_has_no_token_no_rights_and_only_the_callers_that_it_needs(name: str) -> None:
    pod = workload(name)["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["automountServiceAccountToken"] is False
    assert pod["securityContext"]["runAsNonRoot"]
    assert container["securityContext"] == HARDENED
    closed, own = manifest("gausslite", "NetworkPolicy"), manifest(name, "NetworkPolicy")
    assert f"gausslite-{name}" in closed.pop("podSelector")["matchExpressions"][0]["values"]
    assert closed == {"policyTypes": ["Ingress", "Egress"]}
    assert own["podSelector"]["matchLabels"] == {"app": f"gausslite-{name}"}
    reached = [port["port"] for rule in own["ingress"] for port in rule["ports"] if rule["from"]]
    assert reached == [each["containerPort"] for each in container["ports"]]


def test_each_agents_pod_mounts_only_its_own_certificate() -> None:
    kustomization = yaml.safe_load((DEPLOY / "kubernetes/kustomization.yaml").read_text())
    files = {each["name"]: each["files"] for each in kustomization["secretGenerator"]}["agent-tls"]
    names = {f"agent-{i}.{part}.pem" for i in range(workload("agent")["replicas"]) for part in ("cert", "key")}
    assert {word.partition("=")[0] for word in files} == {*names, "certs/ca.pem"}
    mounts = workload("agent")["template"]["spec"]["containers"][0]["volumeMounts"]
    paths = {mount.get("subPath") or mount["subPathExpr"] for mount in mounts if mount["name"] == "certs"}
    assert paths == {"ca.pem", "$(POD_NAME).cert.pem", "$(POD_NAME).key.pem"}


def test_compose_without_certificates_opens_ports_to_its_machine_only() -> None:
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"].values()
    ports = [port for service in services for port in service.get("ports", ())]
    assert [port.partition(":")[0] for port in ports] == ["127.0.0.1"] * 2


def test_no_image_has_a_name_that_a_public_registry_answers() -> None:
    composed = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    for name in PARSERS:
        (container,) = workload(name)["template"]["spec"]["containers"]
        assert container["image"] == f"registry.invalid/gausslite-{name}:unset"
        repository, _, tag = composed[name]["image"].partition(f"/gausslite-{name}:")
        assert (repository, tag) == ("${GAUSSLITE_REGISTRY:-localhost}", "${GAUSSLITE_TAG:-local}")
        assert composed[name]["pull_policy"] == "${GAUSSLITE_PULL_POLICY:-build}"
    for path in (DEPLOY / "compose.tls.yaml", DEPLOY / "compose.models.yaml"):
        assert "image:" not in path.read_text()
    for path in (DEPLOY / "Dockerfile", ROOT / "ros2/Dockerfile"):
        text = path.read_text()
        names = set(re.findall(r"^(?:FROM |ARG PYTHON_IMAGE=)(\S+)", text, re.MULTILINE))
        (base,) = names - set(re.findall(r"^FROM .* AS (\S+)$", text, re.MULTILINE)) - {"${PYTHON_IMAGE}"}
        assert re.fullmatch(r"docker\.io/library/\S+@sha256:[0-9a-f]{64}", base)


@pytest.mark.parametrize("lock", ["requirements", "build-requirements"])
def test_the_lock_files_have_each_requirement_with_hashes(lock: str) -> None:
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = [*content["build-system"]["requires"], *content["dependency-groups"]["build"]]
    if lock == "requirements":
        extras = content["project"]["optional-dependencies"]
        asked = [*content["project"]["dependencies"], *(line for each in EXTRAS for line in extras[each])]
    text = (DEPLOY / f"{lock}.txt").read_text()
    pins = re.findall(r"^(\S+)==(\S+) \\\n    --hash=sha256:", text, re.MULTILINE)
    assert len(pins) == text.count("==")
    versions = {canonicalize_name(name): version for name, version in pins}
    for requirement in map(Requirement, asked):
        assert versions[canonicalize_name(requirement.name)] in requirement.specifier, "run deploy/lock.sh"
