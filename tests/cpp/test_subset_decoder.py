"""The C++ decoder, written from docs/reference/wire.md, gives the Python decoder's values and refuses damage."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.codec.body import SubsetCoding
from gausslite.codec.subset_codec import decode_subset, encode_subset
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel, merge_batches, tombstones

ROOT = Path(__file__).resolve().parents[2]
GRID = VoxelGrid(0.1)
FLAGS = ("-std=c++17", "-O0", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined")


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The decoder with sanitizers: a read beyond a message ends it."""
    if shutil.which("g++") is None or not Path("/usr/include/zstd.h").exists():
        pytest.skip("no g++ or no zstd headers: apt-get install g++ libzstd-dev")
    built = tmp_path_factory.mktemp("cpp") / "print_subset"
    sources = [*(ROOT / "cpp" / "src").glob("*.cpp"), ROOT / "cpp" / "programs" / "print_subset.cpp"]
    include = f"-I{ROOT / 'cpp' / 'include'}"
    subprocess.run(["g++", *FLAGS, include, *map(str, sources), "-lzstd", "-o", str(built)], check=True)
    return built


def messages():
    rng = np.random.default_rng(5)
    n = 400
    crowd = plain_gaussians(
        rng.uniform(-1, 1, (n, 3)),
        scales_m=np.exp(rng.uniform(np.log(2e-5), np.log(0.3), (n, 3))),
        opacities=rng.random(n),
        rgb=rng.uniform(-0.4, 1.4, (n, 3)),
        kappa=rng.integers(0, 1 << 20, n),
        target=rng.integers(-1, 300, n),
    )
    crowd.quats_wxyz[:] = rng.normal(size=(n, 4))
    small = plain_gaussians(rng.uniform(0, 0.3, (60, 3)), kappa=rng.integers(0, 200, 60), target=0)
    removed = tombstones(np.unique(GRID.keys(rng.uniform(2, 3, (5, 3)).astype(np.float32))))
    for batch in (group_by_voxel(crowd, GRID), merge_batches(group_by_voxel(small, GRID), removed), removed):
        for coding in SubsetCoding:
            yield encode_subset(RoiSubset("ant", "s", 3, 4, batch), GRID, coding)
    page = (ROOT / "docs" / "reference" / "wire.md").read_text()
    for found in re.findall(r"(?:Quantised|Lossless), \d+ bytes:\n```\n(.*?)```", page, re.DOTALL):
        yield bytes.fromhex(found)


def run(program, tmp_path, message):
    file = tmp_path / "message"
    file.write_bytes(message)
    return subprocess.run([str(program), str(file)], capture_output=True, text=True, timeout=60)


def test_every_value_is_that_of_the_python_decoder(program, tmp_path):
    for message in messages():
        done = run(program, tmp_path, message)
        assert done.returncode == 0, done.stderr
        subset, grid = decode_subset(message)
        first, *lines = (line.split() for line in done.stdout.splitlines())
        assert first[:5] == ["subset", "ant", "s", str(subset.message_seq), str(subset.update_seq)]
        assert float(first[5]) == grid.size_m
        voxels = [tuple(map(int, line[1:])) for line in lines if line[0] == "voxel"]
        batch = subset.batch
        assert voxels == list(zip(batch.keys.tolist(), batch.kappa_sums.tolist(), batch.counts.tolist(), strict=True))
        rows = [line[1:] for line in lines if line[0] == "gaussian"]
        g = batch.gaussians
        expected = np.column_stack([g.means_m, g.quats_wxyz, g.scales_m, g.opacities, g.rgb])
        got = np.array([row[:14] for row in rows], np.float32).reshape(-1, 14)
        # exp2 of two libraries may differ in the last bit
        np.testing.assert_allclose(got, expected, rtol=2e-7, atol=1e-12)
        np.testing.assert_array_equal(got[:, :7], expected[:, :7])
        labels = np.array([row[14:] for row in rows], np.int64).reshape(-1, 3)
        np.testing.assert_array_equal(labels, np.column_stack([g.active, g.kappa, g.target]))


def test_damaged_messages_are_one_line_and_exit_code_2(program, tmp_path):
    google_crc32c = pytest.importorskip("google_crc32c")
    rng = np.random.default_rng(6)
    whole = list(messages())
    for i in range(60):
        message = bytearray(whole[i % len(whole)])
        if i % 3 == 0:
            message = message[: int(rng.integers(len(message)))]
        else:
            for _ in range(int(rng.integers(1, 4))):
                message[int(rng.integers(6, len(message)))] = int(rng.integers(256))
        if i % 2 and len(message) > 4:
            # a valid checksum, so that the rest is decoded
            message[-4:] = google_crc32c.value(bytes(message[:-4])).to_bytes(4, "little")
        done = run(program, tmp_path, bytes(message))
        assert done.returncode in (0, 2), done.stderr
        assert (done.returncode == 2) == (len(done.stderr.splitlines()) == 1), done.stderr
