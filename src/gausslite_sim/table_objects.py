"""Tables, shelves and cases, each standing on z = 0, its front towards -y; some have their backs to a wall at y = 0."""

from __future__ import annotations

import numpy as np

from gausslite_sim.mesh import box, lathe, merge_meshes, panel
from gausslite_sim.scene_objects import Part
from gausslite_sim.shapes import legs, rods

SPINES = ("spine_1", "spine_2", "spine_3", "spine_4")


def plain_table(
    width_m: float, depth_m: float, height_m: float, top: str, feet: str, splay_m: float = 0.0
) -> list[Part]:
    """A top on four legs."""
    x, y = width_m / 2, depth_m / 2
    slab = box((-x, -y, height_m - 0.035), (x, y, height_m), cell_m=0.05)
    return [Part(slab, top), Part(legs(width_m - 0.12, depth_m - 0.12, height_m - 0.035, 0.045, splay_m), feet)]


def desk(width_m: float, top: str, body: str, drawers: str | None = None) -> list[Part]:
    """A writing desk 0.70 m deep with a metal frame and, if named, a chest of drawers under its right end."""
    parts = plain_table(width_m, 0.7, 0.73, top, body)
    bar = rods([((-width_m / 2 + 0.08, 0.27, 0.35), (width_m / 2 - 0.08, 0.27, 0.35))], 0.012)
    parts.append(Part(bar, body))
    if drawers is not None:
        low, high = (width_m / 2 - 0.5, -0.26, 0.08), (width_m / 2 - 0.1, 0.28, 0.66)
        parts.append(Part(box(low, high), body))
        front = panel((low[0], low[1] - 0.004, high[2]), (high[0] - low[0], 0, 0), (0, 0, low[2] - high[2]), fit=True)
        parts.append(Part(front, drawers))
    return parts


def round_table(radius_m: float, height_m: float, top: str, foot: str) -> list[Part]:
    """A disc on one turned foot."""
    disc = lathe(
        [(0.0005, height_m - 0.03), (radius_m, height_m - 0.03), (radius_m, height_m), (0.0005, height_m)], sectors=40
    )
    profile = [(0.6 * radius_m, 0), (0.6 * radius_m, 0.02), (0.06, 0.06), (0.04, 0.2), (0.045, height_m - 0.03)]
    return [Part(disc, top), Part(lathe(profile, smooth=True), foot)]


def open_shelf(
    width_m: float, height_m: float, wood: str, rng: np.random.Generator, rows: int = 4, depth_m: float = 0.28
) -> list[Part]:
    """Thin boards between two sides, open to the wall, with books of many sizes that leave gaps."""
    x, step = width_m / 2, height_m / rows
    boards = [box((-x, -depth_m, i * step), (x, 0, i * step + 0.018)) for i in range(rows + 1)]
    sides = [box((s * x - 0.009, -depth_m, 0), (s * x + 0.009, 0, height_m + 0.018)) for s in (-1, 1)]
    parts = [Part(merge_meshes([*boards, *sides]), wood)]
    for i in range(rows):
        share = float(rng.uniform(0.45, 0.85))
        start = -x + 0.03 if rng.random() < 0.5 else x - 0.03 - share * (width_m - 0.06)
        parts += book_run(share * (width_m - 0.06), 0.8 * step, rng, (start, -depth_m + 0.05, i * step + 0.018))
    return parts


def book_run(
    length_m: float, tallest_m: float, rng: np.random.Generator, at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> list[Part]:
    """Books side by side along +x, their backs towards -y, the last one leaning."""
    x, y, z = at_m
    end, parts = x + length_m, []
    while x < end - 0.05:
        thick, high = float(rng.uniform(0.018, 0.05)), tallest_m * float(rng.uniform(0.62, 1.0))
        spine = str(rng.choice(SPINES))
        back = panel((x, y, z + high), (thick, 0, 0), (0, 0, -high), fit=True)
        block = box((x, y + 0.001, z), (x + thick - 0.001, y + float(rng.uniform(0.13, 0.18)), z + high))
        parts += [Part(back, spine), Part(block, "cover")]
        x += thick + 0.001
    return parts


def metal_rack(width_m: float, height_m: float, rows: int, depth_m: float = 0.4) -> list[Part]:
    """Four thin uprights with wire shelves."""
    x, y = width_m / 2, depth_m / 2
    posts = legs(width_m, depth_m, height_m, 0.028)
    wires = []
    for i in range(rows):
        z = 0.15 + i * (height_m - 0.2) / (rows - 1)
        wires += [rods([((-x, s * y, z), (x, s * y, z))], 0.008) for s in (-1, 1)]
        wires += [rods([((-x, u, z), (x, u, z))], 0.004) for u in np.linspace(-y, y, 7)[1:-1].tolist()]
        wires += [rods([((s * x, -y, z), (s * x, y, z))], 0.008) for s in (-1, 0, 1)]
    return [Part(merge_meshes([posts, *wires]), "steel")]


def wall_board(width_m: float, wood: str, depth_m: float = 0.22) -> list[Part]:
    """One shelf on brackets, on a wall at y = 0; its upper side is z = 0."""
    board = box((-width_m / 2, -depth_m, -0.025), (width_m / 2, 0, 0))
    brackets = rods(
        [((s * width_m / 3, -depth_m + 0.03, -0.03), (s * width_m / 3, -0.01, -0.18)) for s in (-1, 1)], 0.006
    )
    return [Part(board, wood), Part(brackets, "black_plastic")]


def workbench(width_m: float) -> list[Part]:
    """A heavy bench with a lower board and a vice at its left end."""
    top = box((-width_m / 2, -0.35, 0.82), (width_m / 2, 0.35, 0.9), cell_m=0.06)
    board = box((-width_m / 2 + 0.06, -0.3, 0.2), (width_m / 2 - 0.06, 0.3, 0.23))
    x = -width_m / 2 + 0.22
    jaws = [box((x - 0.1, -0.44, 0.84), (x + 0.1, -0.4, 0.98)), box((x - 0.1, -0.36, 0.9), (x + 0.1, -0.3, 0.98))]
    screw = rods([((x, -0.52, 0.88), (x, -0.34, 0.88)), ((x - 0.12, -0.52, 0.88), (x + 0.12, -0.52, 0.88))], 0.011)
    return [
        Part(merge_meshes([top, board]), "worn_wood"),
        Part(legs(width_m - 0.16, 0.56, 0.82, 0.09), "light_wood"),
        Part(merge_meshes([*jaws, screw]), "blue_paint"),
    ]
