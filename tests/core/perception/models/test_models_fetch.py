"""Model files of the catalogue are fetched, verified, listed and inspected."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from model_server import DIGEST, ServedModel, files_in, no_progress, serving
from tiny_yolo import write_tiny_yolo

from gausslite.cli.main import main
from gausslite.domain.errors import (
    ChecksumError,
    GaussLiteError,
    InvalidInputError,
    ModelFileError,
)
from gausslite.perception.models.catalogue import CATALOGUE, ModelEntry, entry_named, read_catalogue
from gausslite.perception.models.fetch import fetch
from gausslite.perception.models.model_file import listed_checksum


def entry(max_mib: int = 1, sha256: str | None = None) -> ModelEntry:
    return ModelEntry("tiny", "nets/tiny.onnx", "tests", "Apache-2.0", max_mib, sha256)


def test_the_checksum_of_a_fetched_model_is_fixed_from_then_on(tmp_path):
    served = ServedModel()
    served.data = write_tiny_yolo(tmp_path / "source.onnx", ["cup"], []).read_bytes()
    folder = tmp_path / "models"
    with serving(served) as base:
        first, again = (fetch(entry(), base, folder, None, no_progress) for _ in range(2))
    assert len(served.requested_ranges) == 1
    assert listed_checksum(first.path) == first.sha256 == hashlib.sha256(served.data).hexdigest()
    assert (first.checksum_source, again.checksum_source) == ("", "SHA256SUMS")
    assert again == replace(first, checksum_source="SHA256SUMS")


def test_the_checksum_of_a_changed_file_is_not_recorded(tmp_path):
    served, folder = ServedModel(), tmp_path / "models"
    served.data = write_tiny_yolo(tmp_path / "source.onnx", ["cup"], []).read_bytes()
    with serving(served) as base:
        path = fetch(entry(), base, folder, None, no_progress).path
        recorded = listed_checksum(path)
        path.write_bytes(served.data + b"more")
        with pytest.raises(ChecksumError, match="from SHA256SUMS"):
            fetch(entry(), base, folder, None, no_progress)
        # a changed file on the server does not match the recorded checksum either
        path.unlink()
        served.data = write_tiny_yolo(tmp_path / "other.onnx", ["bowl"], []).read_bytes()
        with pytest.raises(ChecksumError, match="the file was not kept"):
            fetch(entry(), base, folder, None, no_progress)
        assert listed_checksum(path) == recorded
        # an explicit checksum overrides it
        digest = hashlib.sha256(served.data).hexdigest()
        fetched = fetch(entry(sha256="0" * 64), base, folder, digest.upper(), no_progress)
    assert (fetched.checksum_source, fetched.sha256, listed_checksum(path)) == ("--sha256", digest, digest)


def test_the_checksum_of_the_catalogue_is_enforced(tmp_path):
    served = ServedModel()
    served.data = write_tiny_yolo(tmp_path / "source.onnx", ["cup"], []).read_bytes()
    folder, digest = tmp_path / "models", hashlib.sha256(served.data).hexdigest()
    with serving(served) as base:
        with pytest.raises(ChecksumError, match="the file was not kept"):
            fetch(entry(sha256="0" * 64), base, folder, None, no_progress)
        assert not (folder / "tiny.onnx").exists()
        assert fetch(entry(sha256=digest), base, folder, None, no_progress).checksum_source == "the catalogue"


def test_a_web_page_under_a_model_name_is_deleted(tmp_path):
    served = ServedModel()
    served.data = b"<!DOCTYPE html><html>Sign in first</html>"
    with serving(served) as base, pytest.raises(ModelFileError, match="a web page"):
        fetch(entry(), base, tmp_path, None, no_progress)
    assert files_in(tmp_path) == []


def test_a_local_file_with_a_wrong_checksum_is_reported_and_kept(tmp_path):
    (tmp_path / "tiny.onnx").write_bytes(b"mine")
    with pytest.raises(ChecksumError, match="move the file away"):
        fetch(entry(sha256=DIGEST), "https://example.org", tmp_path, None, no_progress)
    assert (tmp_path / "tiny.onnx").read_bytes() == b"mine"


def test_the_command_lists_fetches_verifies_and_inspects(tmp_path, capsys, monkeypatch):
    catalogue = tmp_path / "mine.toml"
    catalogue.write_text(
        '[tiny]\npath = "nets/tiny.onnx"\npurpose = "tests"\nlicence = "Apache-2.0"\nmax_mib = 1\n', encoding="utf-8"
    )
    served, folder = ServedModel(), tmp_path / "models"
    served.data = write_tiny_yolo(tmp_path / "source.onnx", ["cup"], []).read_bytes()
    with serving(served) as base:
        monkeypatch.setenv("GAUSSLITE_MODELS_URL", base)
        command = ["models", "fetch", "tiny", "--catalogue", str(catalogue), "--folder", str(folder)]
        assert main(command) == 0
        assert "tiny.onnx: not verified: no expected SHA-256 is given" in capsys.readouterr().err
        assert main([*command, "--sha256", hashlib.sha256(served.data).hexdigest()]) == 0
        first = capsys.readouterr()
        assert "tiny.onnx: verified: its SHA-256 is that of --sha256" in first.err
        assert first.out == f"{folder / 'tiny.onnx'}\n"
    path = str(folder / "tiny.onnx")
    assert main(["models", "list", "--catalogue", str(catalogue), "--folder", str(folder)]) == 0
    assert main(["models", "verify", path]) == 0
    assert main(["models", "inspect", path]) == 0
    captured = capsys.readouterr().out
    for expected in (
        path,
        "local",
        "the checksum in SHA256SUMS and a whole YOLO-seg or FastSAM network",
        "images [1, 3, 64, 64] float",
        "CPU",
    ):
        assert expected in captured
    (folder / "tiny.onnx").write_bytes(served.data[:-1])
    assert main(["models", "verify", path]) == 2
    assert main(["models", "fetch", "unheard-of"]) == 2
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) == 2


def test_fetching_needs_an_address(monkeypatch, capsys):
    monkeypatch.delenv("GAUSSLITE_MODELS_URL", raising=False)
    assert main(["models", "fetch", "fastsam"]) == 2
    assert "--base-url" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text",
    [
        "no toml",
        "tiny = 3",
        '[tiny]\npath = "a.onnx"',
        '[tiny]\npath = "../a.onnx"\npurpose = ""\nlicence = ""\nmax_mib = 1',
        '[tiny]\npath = "a.onnx"\npurpose = ""\nlicence = ""\nmax_mib = 0',
        '[tiny]\npath = "a.onnx"\npurpose = ""\nlicence = ""\nmax_mib = 1\nsha256 = "abc"',
    ],
)
def test_an_invalid_catalogue_is_rejected_in_one_line(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(GaussLiteError, match="catalogue") as caught:
        read_catalogue(path)
    assert "\n" not in str(caught.value)


def test_catalogue_names_and_files_are_distinct_and_an_unknown_name_lists_them():
    assert len({each.name for each in CATALOGUE}) == len({each.file_name for each in CATALOGUE}) == len(CATALOGUE)
    with pytest.raises(InvalidInputError, match="grounding-dino"):
        entry_named(CATALOGUE, "dino")


@pytest.mark.parametrize("name", [entry.name for entry in CATALOGUE])
def test_every_file_has_a_source_whose_commands_can_be_pasted(capsys, name):
    found = entry_named(CATALOGUE, name)
    assert main(["models", "source", name]) == 0
    printed = capsys.readouterr().out
    assert found.project
    assert f"licence   {found.licence}\n" in printed
    assert printed.endswith(f"export:\n{found.export}\n")
    assert "://" not in printed
    for command in found.export.split('python -c "')[1:]:
        compile(command.split('"')[0], name, "exec")
    for command in found.export.splitlines():
        if command.startswith("tools/"):
            assert (Path(__file__).resolve().parents[4] / command.split()[0]).is_file()
