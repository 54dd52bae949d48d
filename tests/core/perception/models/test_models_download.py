"""Downloads from an in-process server are complete and verified, or absent; interrupted ones resume."""

from __future__ import annotations

import hashlib

import pytest
from model_server import DATA, DIGEST, ServedModel, files_in, no_progress, serving

from gausslite.domain.errors import (
    ChecksumError,
    InvalidInputError,
    QuotaError,
    UnavailableError,
)
from gausslite.perception.models.download import DownloadRequest, download, require_https


def request(base: str, folder, sha256: str | None = DIGEST, max_bytes: int = 1 << 20) -> DownloadRequest:
    return DownloadRequest(f"{base}/thing.bin", folder / "thing.bin", max_bytes, sha256)


def test_a_download_is_complete_and_leaves_no_other_file(tmp_path):
    progress = []
    with serving(ServedModel()) as base:
        download(request(base, tmp_path), lambda have, total: progress.append((have, total)))
    assert (tmp_path / "thing.bin").read_bytes() == DATA
    assert files_in(tmp_path) == ["thing.bin"]
    assert progress[0] == (0, len(DATA))
    assert progress[-1] == (len(DATA), len(DATA))


def test_an_interrupted_download_resumes(tmp_path):
    served = ServedModel()
    with serving(served) as base:
        served.stop_at = 500_000
        with pytest.raises(UnavailableError, match="run it again to resume"):
            download(request(base, tmp_path), no_progress)
        assert not (tmp_path / "thing.bin").exists()
        served.stop_at = None
        download(request(base, tmp_path), no_progress)
    assert served.requested_ranges == [None, "bytes=500000-"]
    assert (tmp_path / "thing.bin").read_bytes() == DATA
    assert files_in(tmp_path) == ["thing.bin"]


def test_a_complete_partial_file_is_moved_without_another_download(tmp_path):
    """A process may end after the last byte and before it moves the file."""
    served = ServedModel()
    (tmp_path / ".thing.bin.part").write_bytes(DATA)
    (tmp_path / ".thing.bin.part.etag").write_text(served.tag)
    with serving(served) as base:
        download(request(base, tmp_path), no_progress)
    assert served.requested_ranges == [f"bytes={len(DATA)}-"]
    assert (tmp_path / "thing.bin").read_bytes() == DATA
    assert files_in(tmp_path) == ["thing.bin"]


def test_a_partial_file_longer_than_the_servers_file_restarts_the_download(tmp_path):
    served = ServedModel()
    (tmp_path / ".thing.bin.part").write_bytes(DATA + b"more")
    (tmp_path / ".thing.bin.part.etag").write_text(served.tag)
    with serving(served) as base:
        with pytest.raises(UnavailableError, match="run it again to restart"):
            download(request(base, tmp_path), no_progress)
        download(request(base, tmp_path), no_progress)
    assert (tmp_path / "thing.bin").read_bytes() == DATA


@pytest.mark.parametrize("tag", ['"v2"', 'W/"v1"'])
def test_a_changed_file_on_the_server_restarts_the_download(tmp_path, tag):
    served = ServedModel()
    with serving(served) as base:
        served.stop_at, served.tag = 1000, '"v1"' if tag == '"v2"' else tag
        with pytest.raises(UnavailableError):
            download(request(base, tmp_path), no_progress)
        served.stop_at, served.tag, served.data = None, tag, DATA[::-1]
        download(request(base, tmp_path, hashlib.sha256(DATA[::-1]).hexdigest()), no_progress)
    assert (tmp_path / "thing.bin").read_bytes() == DATA[::-1]


def test_a_file_with_a_wrong_checksum_is_deleted(tmp_path):
    served = ServedModel()
    with serving(served) as base:
        served.data = b"\1" + DATA[1:]
        with pytest.raises(ChecksumError, match="the file was not kept"):
            download(request(base, tmp_path), no_progress)
        assert files_in(tmp_path) == []
        served.data = DATA
        download(request(base, tmp_path), no_progress)
    assert (tmp_path / "thing.bin").read_bytes() == DATA


@pytest.mark.parametrize("states_length", [True, False])
def test_a_file_is_never_written_past_its_limit(tmp_path, states_length):
    served = ServedModel()
    served.states_length = states_length
    with serving(served) as base, pytest.raises(QuotaError, match="at most 1000 bytes"):
        download(request(base, tmp_path, max_bytes=1000), no_progress)
    assert sum(path.stat().st_size for path in tmp_path.glob(".thing.bin.part")) <= 1000
    assert not (tmp_path / "thing.bin").exists()


@pytest.mark.parametrize(
    "url", ["http://example.org/a", "ftp://localhost/a", "file:///etc/passwd", "https://", "x", ""]
)
def test_only_https_is_accepted_except_on_this_machine(url):
    with pytest.raises(InvalidInputError, match="expected an https:// address"):
        require_https(url)
    require_https("https://example.org/a")
    require_https("http://localhost:8000/a")


def test_a_redirect_to_http_is_not_followed(tmp_path):
    served = ServedModel()
    served.redirect = "http://example.org/thing.bin"
    with serving(served) as base, pytest.raises(InvalidInputError, match=r"example\.org"):
        download(request(base, tmp_path), no_progress)


def test_a_missing_file_or_server_is_reported_in_one_line(tmp_path):
    with serving(ServedModel()) as base:
        with pytest.raises(UnavailableError, match="404"):
            download(DownloadRequest(f"{base}/other", tmp_path / "other", 10), no_progress)
        gone = base
    with pytest.raises(UnavailableError, match="cannot be reached") as caught:
        download(DownloadRequest(f"{gone}/thing.bin", tmp_path / "thing.bin", 10), no_progress)
    assert "\n" not in str(caught.value)
