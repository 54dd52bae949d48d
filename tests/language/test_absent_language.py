"""Without this package a region is mapped, services start, and one line names the package where a sentence comes."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from absent_package import remove_package
from other_process import environment_without, run_python

from gausslite.cli.main import main
from gausslite.nouns import PlainNouns, meant_by, vocabulary
from gausslite_language import nouns

MISSING = "needs the package gausslite_language, which is not installed"
FRAMES = ("sim:home?frames=2&size=80x60", "--out")


@pytest.fixture
def without_language(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    remove_package(monkeypatch, "gausslite_language")
    vocabulary.cache_clear()
    yield
    vocabulary.cache_clear()


@pytest.mark.usefixtures("without_language")
def test_regions_are_mapped(tmp_path: Path) -> None:
    regions, out = tmp_path / "regions.npz", tmp_path / "run"
    np.savez(regions, voxel_size_m=1.0, wall=np.argwhere(np.ones((6, 6, 3))))
    assert main(["map", *FRAMES, str(out), "--roi", str(regions)]) == 0
    assert (out / "map.ply").is_file()


@pytest.mark.parametrize(
    "arguments",
    [
        ("gausslite", "map", *FRAMES, "run", "--task", "Pick up the mug"),
        ("gausslite", "parse", "Pick up the mug"),
        ("gausslite", "objects", "run"),
        ("gausslite_agent", "--listen", "127.0.0.1:0", "--task", "Pick up the mug", "--source", "sim:home"),
        ("gausslite_parser", "--listen", "127.0.0.1:0"),
    ],
)
def test_one_line_names_the_package_where_it_is_needed(arguments: Sequence[str], tmp_path: Path) -> None:
    # in a process of its own: this one may keep a parser from before
    out = [str(tmp_path / text) if text == "run" else text for text in arguments]
    done = run_python("-m", *out, environment=environment_without("gausslite_language"))
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].endswith(MISSING)
    assert "Traceback" not in done.stderr


def test_services_and_their_settings_are_imported() -> None:
    modules = "gausslite.api, gausslite_agent.program, gausslite_fusion_server.program, gausslite_parser.program"
    done = run_python("-c", f"import {modules}", environment=environment_without("gausslite_language"))
    assert done.returncode == 0, done.stderr


def test_the_core_uses_the_installed_vocabulary_and_heads_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert vocabulary() is nouns
    names = ("lawn chair", "mug", "tap", "wall")
    assert meant_by("faucet", names) == ("tap",)
    monkeypatch.setattr("gausslite.nouns.vocabulary", PlainNouns)
    assert [meant_by(noun, names) for noun in ("faucet", "chair", "cup")] == [(), ("lawn chair",), ("mug",)]
