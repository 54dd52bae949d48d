"""Files that are something else than their name says are named by their first bytes."""

import gzip
import io
import tarfile
from pathlib import Path

import pytest

import gausslite as gl

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:5d5d\nsize 34\n"


def tar() -> bytes:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("rgb.txt"))
    return data.getvalue()


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.r3d", "recording", "a.ply"])
@pytest.mark.parametrize(
    ("content", "found"),
    [
        (POINTER, "a Git LFS pointer"),
        (b"\n<!DOCTYPE html>", "a web page"),
        (gzip.compress(b"x", mtime=0), "a gzip archive; unpack it first"),
        (gzip.compress(b"NGSP\3\0\0\0", mtime=0), "an SPZ map"),
        (tar(), "a tar archive; unpack it first"),
        (b"\x89PNG\r\n\x1a\n", "a PNG image"),
        (b"", "an empty file"),
    ],
)
def test_a_foreign_file_is_named(tmp_path: Path, name: str, content: bytes, found: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    read = gl.load_ply if name == "a.ply" else gl.open_sequence
    with pytest.raises(gl.GaussLiteError) as caught:
        read(str(path))
    assert found in str(caught.value)
    assert str(path) in str(caught.value)
    assert "repairs a recording" not in str(caught.value)


def test_a_folder_of_pointers_is_named(tmp_path: Path) -> None:
    for name in ("metadata.yaml", "run_0.db3"):
        (tmp_path / name).write_bytes(POINTER)
    pytest.raises(gl.GaussLiteError, gl.open_sequence, str(tmp_path)).match(r"got a Git LFS pointer .*run_0.db3")
