"""Random voxel updates for the tests of messages and stores."""

import numpy as np
from sample_gaussians import uniform_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid


def make_batch(seed: int, n: int, grid: VoxelGrid, spread_m: float = 1.0, centre_m: float = 0.0) -> VoxelBatch:
    """Random voxel updates, some of them tombstones, with values at and beyond the limits of the codec."""
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        (centre_m + rng.uniform(-spread_m, spread_m, (n, 3))).astype(np.float32),
        rng.choice([rng.normal(size=(n, 4)), rng.choice([-0.5, 0.5], (n, 4))]).astype(np.float32),
        np.exp(rng.uniform(np.log(1e-7), np.log(50), (n, 3))).astype(np.float32),
        rng.choice([rng.random(n), rng.choice([0.0, 1.0], n)]).astype(np.float32),
        rng.uniform(-0.5, 1.5, (n, 3)).astype(np.float32),
        rng.random(n) < 0.5,
        rng.integers(0, rng.choice([2**8, 2**16, 2**32]), n, dtype=np.uint32),
        rng.integers(-1, rng.choice([5, 2**15]), n, dtype=np.int16),
    )
    keys = grid.keys(gaussians.means_m)
    order = np.argsort(keys, kind="stable")
    found, counts = np.unique(keys, return_counts=True)
    gone = np.setdiff1d(found + 1, found)[: rng.integers(0, 3)]
    every = np.concatenate([found, gone])
    sums = rng.integers(0, 2**60, len(every), dtype=np.uint64)
    counts = np.concatenate([counts, np.zeros(len(gone), np.int64)]).astype(np.uint32)
    by_key = np.argsort(every)
    return VoxelBatch(every[by_key], sums[by_key], counts[by_key], gaussians.take(order))


def random_subset(agent_id: str, update_seq: int, counts: dict[int, int], kappa: int = 1, seed: int = 0) -> RoiSubset:
    """A subset with these numbers of Gaussians, all of one kappa, by voxel key."""
    n = sum(counts.values())
    rng = np.random.default_rng(seed)
    gaussians = uniform_gaussians(rng, n, active=np.arange(n) % 2 == 0, kappa=kappa, target=-1)
    keys = sorted(counts)
    per_voxel = np.array([counts[key] for key in keys], np.uint32)
    batch = VoxelBatch(np.array(keys, np.int64), per_voxel.astype(np.uint64) * np.uint64(kappa), per_voxel, gaussians)
    return RoiSubset(agent_id, "session", update_seq, update_seq, batch)
