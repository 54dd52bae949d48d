"""`gausslite bench codec`: the formats in order of size, and exact decoders."""

from __future__ import annotations

import numpy as np

from gausslite.domain.gaussians import Gaussians
from gausslite_bench.codec.formats import codec_formats
from gausslite_bench.codec.scores import codec_table, measure_formats


def surface(n: int) -> Gaussians:
    """A wavy wall of Gaussians of a few millimetres, every third one active."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 1, (2, n))
    means = np.stack([x, y, 1 + 0.05 * np.sin(6 * x)], axis=1)
    colours = np.clip(np.stack([x, y, 1 - x], axis=1) + rng.normal(0, 0.05, (n, 3)), 0, 1)
    quats = np.array([1, 0, 0, 0]) + rng.normal(0, 0.15, (n, 4))
    return Gaussians(
        means.astype(np.float32),
        quats.astype(np.float32),
        np.exp(rng.normal(np.log(5e-3), 0.6, (n, 3))).astype(np.float32),
        rng.uniform(0.2, 0.9, n).astype(np.float32),
        colours.astype(np.float32),
        np.arange(n) % 3 == 0,
        rng.integers(10, 100, n).astype(np.uint32),
        np.zeros(n, np.int16),
    )


def test_the_formats_are_measured_on_the_region_and_on_the_whole_map() -> None:
    # gsply compiles its encoders for minutes, so they are left to the command
    formats = [each for each in codec_formats() if each.name not in ("SPZ", "compressed PLY")]
    scores = measure_formats("wall", surface(3000), (), formats, threads=1)
    contents = [(each.content, each.gaussians) for each in scores[:: len(formats)]]
    assert contents == [("region", 1000), ("hand-over", 3000)]
    sizes = {each.format: each.bytes_per_gaussian for each in scores if each.content == "hand-over"}
    ordered = [sizes[name] for name in ("subset codec", "f16 columns, zstd", ".splat", "f32 columns, zstd", "PLY")]
    assert ordered == sorted(ordered)
    assert ordered[0] <= 12
    assert len(codec_table(scores).splitlines()) == 2 + len(scores)


def test_exact_formats_return_every_gaussian() -> None:
    sent = surface(200)
    for each in codec_formats()[1:3]:
        assert each.decode is not None
        got = each.decode(each.encode(sent))
        assert sorted(map(tuple, got.means_m.tolist())) == sorted(map(tuple, sent.means_m.tolist())), each.name
