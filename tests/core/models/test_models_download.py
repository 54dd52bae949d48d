"""Downloads from a real server in process: whole or not at all, from where they were cut off, never wrong."""

from __future__ import annotations

import hashlib

import pytest
from model_shelf import DATA, DIGEST, Shelf, left_in, nothing_shown, serving

from gausslite.errors import (
    ChecksumError,
    InvalidInputError,
    QuotaError,
    UnavailableError,
)
from gausslite.models.download import DownloadRequest, download, require_https


def wanted(base: str, folder, sha256: str | None = DIGEST, max_bytes: int = 1 << 20) -> DownloadRequest:
    return DownloadRequest(f"{base}/thing.bin", folder / "thing.bin", max_bytes, sha256)


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
        require_https(url)
    require_https("https://example.org/a")
    require_https("http://localhost:8000/a")


def test_a_redirect_to_an_unsafe_address_is_not_followed(tmp_path):
    shelf = Shelf()
    shelf.redirect = "http://example.org/thing.bin"
    with serving(shelf) as base, pytest.raises(InvalidInputError, match=r"example\.org"):
        download(wanted(base, tmp_path), nothing_shown)


def test_a_server_that_has_no_such_file_or_is_not_there_is_told_in_one_line(tmp_path):
    with serving(Shelf()) as base:
        with pytest.raises(UnavailableError, match="404"):
            download(DownloadRequest(f"{base}/other", tmp_path / "other", 10), nothing_shown)
        gone = base
    with pytest.raises(UnavailableError, match="cannot be reached") as caught:
        download(DownloadRequest(f"{gone}/thing.bin", tmp_path / "thing.bin", 10), nothing_shown)
    assert "\n" not in str(caught.value)
