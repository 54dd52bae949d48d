"""Properties of the repository: README, file lengths, docstrings, calls, use of intrinsics, no unpickling."""

import ast
import re
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MAX_POSITIONAL = 6
INTRINSICS = {"fx_px", "fy_px", "cx_px", "cy_px"}
MAY_COMPUTE_WITH_INTRINSICS = ("gausslite/domain/camera.py", "gausslite/render/", "gausslite_gpu/motion.py")


def _tracked(*patterns: str) -> list[Path]:
    done = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [ROOT / line for line in done.stdout.splitlines() if (ROOT / line).is_file()]


@cache
def _production() -> list[tuple[str, ast.Module]]:
    """Return the path and the syntax tree of each module that is not generated."""
    paths = [path for path in _tracked("src/*.py", "services/*.py", "ros2/*.py") if "v1" not in path.parts]
    return [(str(path.relative_to(ROOT)), ast.parse(path.read_text())) for path in paths]


def test_readme_has_exactly_the_two_commands() -> None:
    readme = (ROOT / "README.md").read_text()
    assert re.findall(r"<!-- command: (\w+) -->", readme) == ["demo", "tests"]


def test_older_python_versions_are_refused_before_pip_searches() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    minimum = project["project"]["requires-python"].removeprefix(">=")
    [refusal] = project["tool"]["scikit-build"]["overrides"]
    assert refusal["if"] == {"python-version": f"<{minimum}"}
    assert refusal["fail"] is True
    assert f"needs Python {minimum} or newer" in refusal["messages"]["after-failure"]


def test_wheels_are_built_for_every_declared_python() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    declared = [line.rpartition(":: 3.")[2] for line in project["project"]["classifiers"] if "Python :: 3." in line]
    assert project["tool"]["cibuildwheel"]["build"] == [f"cp3{minor}-manylinux_*" for minor in declared]
    assert project["project"]["requires-python"] == f">=3.{declared[0]}"


def test_source_files_have_at_most_600_lines() -> None:
    # a longer file has more than one reason to open it; a lower limit would only merge and split files
    sources = [path for path in _tracked("*.py", "*.cpp", "*.h") if "v1" not in path.parts]
    too_long = {str(p.relative_to(ROOT)): n for p in sources if (n := len(p.read_text().splitlines())) > 600}
    assert not too_long


def test_every_module_has_a_docstring() -> None:
    undocumented = [
        str(path.relative_to(ROOT))
        for path in _tracked("src/*.py", "services/*.py")
        if "v1" not in path.parts and not path.read_text().startswith('"""')
    ]
    assert not undocumented


def test_loop_variables_name_the_thing() -> None:
    unnamed = [
        f"{path}:{node.target.lineno}"
        for path, tree in _production()
        for node in ast.walk(tree)
        if isinstance(node, ast.For | ast.AsyncFor | ast.comprehension)
        and any(isinstance(part, ast.Name) and part.id == "each" for part in ast.walk(node.target))
    ]
    assert not unnamed


def test_services_is_a_folder_and_not_a_package() -> None:
    assert not list((ROOT / "services").glob("__init__.py"))
    assert not list((ROOT / "services").glob("*/__init__.py"))


def test_nothing_is_unpickled() -> None:
    unsafe = re.compile(
        r"import (pickle|marshal|shelve)\b|from (pickle|marshal|shelve) |allow_pickle=True"
        r"|torch\.load\((?!.*weights_only=True)"
    )
    modules = _tracked("src/*.py", "services/*.py")
    assert not [str(path.relative_to(ROOT)) for path in modules if unsafe.search(path.read_text())]


def test_no_call_has_more_than_six_positional_arguments() -> None:
    too_many = [
        f"{path}:{node.lineno} passes {len(node.args)}"
        for path, tree in _production()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and len(node.args) > MAX_POSITIONAL
    ]
    assert not too_many


def test_only_the_camera_and_the_rasterizers_compute_with_intrinsics() -> None:
    computing = [
        f"{path}:{node.lineno}"
        for path, tree in _production()
        if not any(allowed in path for allowed in MAY_COMPUTE_WITH_INTRINSICS)
        for node in ast.walk(tree)
        if isinstance(node, ast.BinOp)
        for side in (node.left, node.right)
        if isinstance(side, ast.Attribute) and side.attr in INTRINSICS
    ]
    assert not computing
