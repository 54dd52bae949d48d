"""Fetching model files from a real server in process: whole or not at all, from where it was cut off, never wrong."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from tiny_yolo import write_tiny_yolo

from gausslite.cli.main import main
from gausslite.errors import (
    ChecksumError,
    GaussLiteError,
    InvalidInputError,
    ModelFileError,
    QuotaError,
    UnavailableError,
)
from gausslite.models.catalogue import CATALOGUE, ModelEntry, entry_named, read_catalogue
from gausslite.models.download import Wanted, download, require_safe
from gausslite.models.fetch import fetch
from gausslite.perception.model_file import listed_checksum

DATA = bytes(range(256)) * 3000
DIGEST = hashlib.sha256(DATA).hexdigest()


class Shelf:
    """What the server has, how it behaves, and what it was asked for."""

    def __init__(self) -> None:
        self.data, self.tag = DATA, '"v1"'
        self.cut_at: int | None = None
        self.redirect: str | None = None
        self.says_length = True
        self.asked: list[str | None] = []


@contextmanager
def serving(shelf: Shelf) -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            shelf.asked.append(wanted)
            if shelf.redirect is not None:
                self.send_response(302)
                self.send_header("Location", shelf.redirect)
                self.end_headers()
                return
            if not self.path.endswith("/thing.bin") and not self.path.endswith(".onnx"):
                self.send_error(404)
                return
            start = int(wanted[6:-1]) if wanted and self.headers.get("If-Range") == shelf.tag else 0
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(shelf.data) - 1}/{len(shelf.data)}")
            if shelf.says_length:
                self.send_header("Content-Length", str(len(shelf.data) - start))
            self.send_header("ETag", shelf.tag)
            self.end_headers()
            self.wfile.write(shelf.data[start : shelf.cut_at])

        def log_message(self, *_: object) -> None:
            """Quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/files"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def wanted(base: str, folder, sha256: str | None = DIGEST, max_bytes: int = 1 << 20) -> Wanted:
    return Wanted(f"{base}/thing.bin", folder / "thing.bin", max_bytes, sha256)


def nothing_shown(have: int, total: int | None) -> None:
    """No bar in tests."""


def left_in(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_comes_whole_and_leaves_nothing_else(tmp_path):
    shown = []
    with serving(Shelf()) as base:
        download(wanted(base, tmp_path), lambda have, total: shown.append((have, total)))
    assert (tmp_path / "thing.bin").read_bytes() == DATA
    assert left_in(tmp_path) == ["thing.bin"]
    assert shown[0] == (0, len(DATA))
    assert shown[-1] == (len(DATA), len(DATA))


def test_what_was_cut_off_goes_on_where_it_ended(tmp_path):
    shelf = Shelf()
    with serving(shelf) as base:
        shelf.cut_at = 500_000
        with pytest.raises(UnavailableError, match="run it again to go on"):
            download(wanted(base, tmp_path), nothing_shown)
        assert not (tmp_path / "thing.bin").exists()
        shelf.cut_at = None
        download(wanted(base, tmp_path), nothing_shown)
    assert shelf.asked == [None, "bytes=500000-"]
    assert (tmp_path / "thing.bin").read_bytes() == DATA
    assert left_in(tmp_path) == ["thing.bin"]


@pytest.mark.parametrize("tag", ['"v2"', 'W/"v1"'])
def test_another_file_on_the_server_is_begun_anew(tmp_path, tag):
    shelf = Shelf()
    with serving(shelf) as base:
        shelf.cut_at, shelf.tag = 1000, '"v1"' if tag == '"v2"' else tag
        with pytest.raises(UnavailableError):
            download(wanted(base, tmp_path), nothing_shown)
        shelf.cut_at, shelf.tag, shelf.data = None, tag, DATA[::-1]
        download(wanted(base, tmp_path, hashlib.sha256(DATA[::-1]).hexdigest()), nothing_shown)
    assert (tmp_path / "thing.bin").read_bytes() == DATA[::-1]


def test_a_wrong_file_is_not_kept_and_does_not_spoil_the_next_try(tmp_path):
    shelf = Shelf()
    with serving(shelf) as base:
        shelf.data = b"\1" + DATA[1:]
        with pytest.raises(ChecksumError, match="the file was not kept"):
            download(wanted(base, tmp_path), nothing_shown)
        assert left_in(tmp_path) == []
        shelf.data = DATA
        download(wanted(base, tmp_path), nothing_shown)
    assert (tmp_path / "thing.bin").read_bytes() == DATA


@pytest.mark.parametrize("says_length", [True, False])
def test_a_file_that_is_too_large_is_never_written_past_its_limit(tmp_path, says_length):
    shelf = Shelf()
    shelf.says_length = says_length
    with serving(shelf) as base, pytest.raises(QuotaError, match="at most 1000 bytes"):
        download(wanted(base, tmp_path, max_bytes=1000), nothing_shown)
    assert sum(path.stat().st_size for path in tmp_path.glob(".thing.bin.part")) <= 1000
    assert not (tmp_path / "thing.bin").exists()


@pytest.mark.parametrize(
    "url", ["http://example.org/a", "ftp://localhost/a", "file:///etc/passwd", "https://", "x", ""]
)
def test_only_https_is_safe_but_for_this_machine(url):
    with pytest.raises(InvalidInputError, match="expected an https:// address"):
        require_safe(url)
    require_safe("https://example.org/a")
    require_safe("http://localhost:8000/a")


def test_a_redirect_to_an_unsafe_address_is_not_followed(tmp_path):
    shelf = Shelf()
    shelf.redirect = "http://example.org/thing.bin"
    with serving(shelf) as base, pytest.raises(InvalidInputError, match=r"example\.org"):
        download(wanted(base, tmp_path), nothing_shown)


def test_a_server_that_has_no_such_file_or_is_not_there_is_told_in_one_line(tmp_path):
    with serving(Shelf()) as base:
        with pytest.raises(UnavailableError, match="404"):
            download(Wanted(f"{base}/other", tmp_path / "other", 10), nothing_shown)
        gone = base
    with pytest.raises(UnavailableError, match="cannot be reached") as caught:
        download(Wanted(f"{gone}/thing.bin", tmp_path / "thing.bin", 10), nothing_shown)
    assert "\n" not in str(caught.value)


def entry(max_mib: int = 1, sha256: str | None = None) -> ModelEntry:
    return ModelEntry("tiny", "nets/tiny.onnx", "tests", "Apache-2.0", max_mib, sha256)


def test_a_fetched_model_is_held_to_its_checksum_from_then_on(tmp_path):
    shelf = Shelf()
    shelf.data = write_tiny_yolo(tmp_path / "source.onnx", ["cup"], []).read_bytes()
    folder = tmp_path / "models"
    with serving(shelf) as base:
        path = fetch(entry(), base, folder, None, nothing_shown)
        assert fetch(entry(), base, folder, None, nothing_shown) == path
    assert len(shelf.asked) == 1
    assert listed_checksum(path) == hashlib.sha256(shelf.data).hexdigest()


def test_a_web_page_under_a_models_name_is_not_kept(tmp_path):
    shelf = Shelf()
    shelf.data = b"<!DOCTYPE html><html>Sign in first</html>"
    with serving(shelf) as base, pytest.raises(ModelFileError, match="a web page"):
        fetch(entry(), base, tmp_path, None, nothing_shown)
    assert left_in(tmp_path) == []


def test_a_file_that_is_here_but_wrong_is_told_and_left(tmp_path):
    (tmp_path / "tiny.onnx").write_bytes(b"mine")
    with pytest.raises(ChecksumError, match="move the file away"):
        fetch(entry(sha256=DIGEST), "https://example.org", tmp_path, None, nothing_shown)
    assert (tmp_path / "tiny.onnx").read_bytes() == b"mine"


def test_the_command_lists_fetches_verifies_and_inspects(tmp_path, capsys, monkeypatch):
    catalogue = tmp_path / "mine.toml"
    catalogue.write_text(
        '[tiny]\npath = "nets/tiny.onnx"\npurpose = "tests"\nlicence = "Apache-2.0"\nmax_mib = 1\n', encoding="utf-8"
    )
    shelf, folder = Shelf(), tmp_path / "models"
    shelf.data = write_tiny_yolo(tmp_path / "source.onnx", ["cup"], []).read_bytes()
    with serving(shelf) as base:
        monkeypatch.setenv("GAUSSLITE_MODELS_URL", base)
        assert main(["models", "fetch", "tiny", "--catalogue", str(catalogue), "--folder", str(folder)]) == 0
    path = str(folder / "tiny.onnx")
    assert main(["models", "list", "--catalogue", str(catalogue), "--folder", str(folder)]) == 0
    assert main(["models", "verify", path]) == 0
    assert main(["models", "inspect", path]) == 0
    said = capsys.readouterr().out
    for expected in (
        path,
        "here",
        "the checksum in SHA256SUMS and a whole YOLO-seg or FastSAM network",
        "images [1, 3, 64, 64] float",
        "CPU",
    ):
        assert expected in said
    (folder / "tiny.onnx").write_bytes(shelf.data[:-1])
    assert main(["models", "verify", path]) == 2
    assert main(["models", "fetch", "unheard-of"]) == 2
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) == 2


def test_without_an_address_nothing_is_fetched(monkeypatch, capsys):
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
def test_a_wrong_catalogue_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(GaussLiteError, match="catalogue") as caught:
        read_catalogue(path)
    assert "\n" not in str(caught.value)


def test_names_and_files_of_the_catalogue_are_distinct_and_a_wrong_name_is_told_the_right_ones():
    assert len({each.name for each in CATALOGUE}) == len({each.file_name for each in CATALOGUE}) == len(CATALOGUE)
    with pytest.raises(InvalidInputError, match="grounding-dino"):
        entry_named(CATALOGUE, "dino")
