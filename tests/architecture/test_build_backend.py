"""The folder in which `pip install` compiles: a second installation of a clone finds the objects of the first."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture
def backend(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The build backend on a builder that returns the folder it is given; in a source of its own."""

    def build(_folder: str, settings: dict[str, str], _metadata: str | None) -> str:
        return settings.get("build-dir", "of pyproject.toml")

    core = ModuleType("scikit_build_core")
    core.build = MagicMock(build_wheel=build, build_editable=build)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "scikit_build_core", core)
    spec = importlib.util.spec_from_file_location("build_backend", TOOLS / "build_backend.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    source = tmp_path / "clone"
    source.mkdir()
    monkeypatch.chdir(source)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return module


def test_a_clone_that_can_be_written_is_built_in_its_own_folder(backend: Any) -> None:
    assert backend.build_wheel("dist") == "of pyproject.toml"


def test_another_clone_is_built_in_a_folder_that_stays(
    backend: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setattr(os, "access", lambda path, _: path.is_relative_to(cache))
    first, second = backend.build_wheel("dist"), backend.build_editable("dist")
    assert first == second
    assert Path(first).parent.is_relative_to(cache)
    assert Path(first).name == "{wheel_tag}"
    assert backend.build_wheel("dist", {"build-dir": "mine"}) == "mine"
    # a cache that is a file, one of another user, and none
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert "gausslite-build-" in backend.build_wheel("dist")
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    assert "gausslite-build-" in backend.build_wheel("dist")
    for variable in ("XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(variable)
    monkeypatch.setattr("pwd.getpwuid", MagicMock(side_effect=KeyError))
    assert "gausslite-build-" in backend.build_wheel("dist")


def test_a_clone_with_a_file_named_build_is_built_elsewhere(backend: Any, tmp_path: Path) -> None:
    Path("build").touch()
    assert Path(backend.build_wheel("dist")).is_relative_to(tmp_path / "cache")
