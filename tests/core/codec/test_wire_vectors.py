"""The test vectors of docs/reference/wire.md: the format does not change without a new version."""

import re
from pathlib import Path

import numpy as np
import pytest

from gausslite.codec.body import SubsetCoding
from gausslite.codec.subset_codec import decode_subset, encode_subset
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel, merge_batches, tombstones

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "wire.md"
GRID = VoxelGrid(0.1)


def vector(coding: SubsetCoding) -> bytes:
    text = PAGE.read_text()
    [found] = re.findall(rf"{coding.name.capitalize()}, \d+ bytes:\n```\n(.*?)```", text, re.DOTALL)
    return bytes.fromhex(found)


def subset() -> RoiSubset:
    gaussians = Gaussians(
        np.array([[0.02, 0.05, 1.08], [0.07, 0.01, 1.03]], np.float32),
        np.array([[0.8, 0.6, 0, 0]] * 2, np.float32),
        np.array([[0.01, 0.02, 0.005], [0.00005, 0.004, 0.002]], np.float32),
        np.array([0.5, 0.9], np.float32),
        np.array([[0.8, 0.4, 0.2], [0.1, 0.5, 0.9]], np.float32),
        np.ones(2, np.bool_),
        np.array([5, 7], np.uint32),
        np.zeros(2, np.int16),
    )
    removed = GRID.keys(np.array([[0.15, 0.05, 1.05]], np.float32))
    return RoiSubset("ant", "s", 1, 2, merge_batches(group_by_voxel(gaussians, GRID), tombstones(removed)))


@pytest.mark.parametrize("coding", SubsetCoding)
def test_the_vectors_of_the_page_are_what_the_codec_writes(coding: SubsetCoding) -> None:
    assert encode_subset(subset(), GRID, coding) == vector(coding)


@pytest.mark.parametrize("coding", SubsetCoding)
def test_the_vectors_of_the_page_decode_to_the_batch(coding: SubsetCoding) -> None:
    decoded, grid = decode_subset(vector(coding))
    sent, got = subset().batch, decoded.batch
    assert grid == GRID
    assert (decoded.agent_id, decoded.session_id, decoded.message_seq, decoded.update_seq) == ("ant", "s", 1, 2)
    assert got.keys.tolist() == sent.keys.tolist()
    assert (got.kappa_sums.tolist(), got.counts.tolist()) == ([12, 0], [2, 0])
    # 50 um survive
    order = np.argsort(got.gaussians.kappa)
    np.testing.assert_allclose(got.gaussians.scales_m[order], sent.gaussians.scales_m, rtol=0.052)
    np.testing.assert_allclose(got.gaussians.means_m[order], sent.gaussians.means_m, atol=0.0014)
