"""README's first command installs what it promises: nothing but a chosen option needs an optional package."""

import json
import tomllib
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from typing import Any

import pytest
from other_process import environment_without, run_python
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
SUPPORT = ROOT / "tests" / "support"
NEED_AN_EXTRA = {
    "torch": ("gausslite_gpu",),
    "mcp": ("gausslite_mcp.server",),
    "psycopg": tuple(f"gausslite_cluster.{name}" for name in ("peers", "postgres_", "region_", "shared_")),
    "rclpy": ("gausslite_ros.node",),
    "rospy": ("gausslite_ros.node_ros1",),
    "viser": ("gausslite_view",),
}
"""Modules that are imported where an option chooses them, by the package that they need."""


def _installed_closure(requirements: list[str]) -> set[str]:
    """Return the names of the distributions that pip installs for these requirements."""
    found: set[str] = set()
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in found or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        found.add(name)
        try:
            waiting += [Requirement(text) for text in requires(name) or ()]
        except PackageNotFoundError:
            pytest.skip(f"a required package is not installed: {name}")
    return found


def _import_names(distributions: set[str]) -> set[str]:
    return {
        module
        for module, owners in packages_distributions().items()
        if distributions & {canonicalize_name(owner) for owner in owners}
    }


@pytest.fixture(scope="module", params=["quick", pytest.param("all", marks=pytest.mark.slow)])
def results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what a process without optional packages imports and runs, see `minimal_install.py`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = _import_names(_installed_closure(project["dependencies"]))
    sim = _import_names(_installed_closure(project["optional-dependencies"]["sim"])) - required
    visible = required | {name for name in packages_distributions() if name.startswith("gausslite")}
    hidden = {name for name in packages_distributions() if name.isidentifier()} - visible
    out = tmp_path_factory.mktemp("minimal")
    arguments = SUPPORT / "minimal_install.py", out, ",".join(sorted(sim)), request.param
    done = run_python(*arguments, environment=environment_without(*sorted(hidden)), timeout_s=280)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_only_modules_that_an_option_chooses_need_an_optional_package(results: dict[str, Any]) -> None:
    unexpected = {
        module: missing
        for module, missing in results["imports"].items()
        if not module.startswith(NEED_AN_EXTRA.get(missing.partition(".")[0], ()))
    }
    assert unexpected == {}
    assert {missing.partition(".")[0] for missing in results["imports"].values()} == set(NEED_AN_EXTRA)


def test_commands_and_programs_run_without_optional_packages(results: dict[str, Any]) -> None:
    assert [result for result in results["default_paths"] if result["code"] != 0] == []
    assert len(results["default_paths"]) > 25


def test_a_missing_extra_is_named_in_one_line(results: dict[str, Any]) -> None:
    for result in results["missing_extras"]:
        assert result["code"] == 2, result
        assert "Traceback" not in "".join(result["messages"]), result
        assert f"pip install 'gausslite[{result['extra']}]'" in result["messages"][-1], result
