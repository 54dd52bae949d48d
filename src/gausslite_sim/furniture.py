"""Objects of the two-room home, each in its own frame: standing on z = 0, front towards -y."""

from __future__ import annotations

import numpy as np

from gausslite_sim.mesh import box, lathe, leaf, merge_meshes, panel, ring
from gausslite_sim.scene_objects import Part


def table() -> list[Part]:
    """A dining table of 1.40 x 0.90 m, 0.74 m high."""
    legs = [box((x - 0.035, y - 0.035, 0), (x + 0.035, y + 0.035, 0.70)) for x in (-0.63, 0.63) for y in (-0.38, 0.38)]
    apron = [box((-0.6, y - 0.012, 0.62), (0.6, y + 0.012, 0.70)) for y in (-0.37, 0.37)]
    return [
        Part(box((-0.7, -0.45, 0.70), (0.7, 0.45, 0.74), cell_m=0.03), "oak"),
        Part(merge_meshes(legs + apron), "walnut"),
    ]


def chair() -> list[Part]:
    """A chair with a plaid seat; its back is at +y."""
    frame = [box((x - 0.02, -0.2, 0), (x + 0.02, -0.16, 0.43)) for x in (-0.19, 0.19)]
    frame += [box((x - 0.02, 0.17, 0), (x + 0.02, 0.21, 0.92)) for x in (-0.19, 0.19)]
    frame += [box((-0.17, 0.178, z), (0.17, 0.202, z + 0.07)) for z in (0.58, 0.70)]
    frame += [box((-0.17, y - 0.01, 0.2), (0.17, y + 0.01, 0.23)) for y in (-0.18, 0.19)]
    top = box((-0.21, 0.172, 0.82), (0.21, 0.208, 0.94))
    return [Part(merge_meshes([*frame, top]), "cherry"), Part(box((-0.22, -0.22, 0.43), (0.22, 0.17, 0.475)), "plaid")]


def mug() -> list[Part]:
    """A printed mug, 10 cm high, with a handle at +x."""
    outside = lathe([(0.041, 0.0), (0.043, 0.1)], fit=True)
    inside = lathe([(0.043, 0.1), (0.039, 0.1), (0.036, 0.008), (0.0005, 0.008)])
    handle = ring(0.030, 0.0065, -np.pi / 2, np.pi / 2).translate((0.040, 0, 0.052))
    return [Part(outside, "mug_print"), Part(merge_meshes([inside, handle]), "glaze")]


def vase() -> list[Part]:
    """A belly with a narrow neck."""
    profile = [(0.045, 0.0), (0.075, 0.05), (0.088, 0.11), (0.075, 0.17), (0.042, 0.22), (0.034, 0.26), (0.05, 0.29)]
    inner = lathe([(0.05, 0.29), (0.03, 0.25), (0.0005, 0.2)], smooth=True)
    return [Part(lathe(profile, smooth=True, fit=True), "vase_print"), Part(inner, "glaze")]


def books() -> list[Part]:
    """Three books on top of each other, each turned a little."""
    parts = []
    bottom = 0.0
    for cover, wide, deep, high, yaw in (
        ("cover_red", 0.25, 0.18, 0.035, 8),
        ("cover_blue", 0.22, 0.16, 0.028, -14),
        ("cover_green", 0.19, 0.13, 0.04, 22),
    ):
        x, y, lid = wide / 2, deep / 2, 0.004
        boards = [box((-x, -y, z), (x, y, z + lid), fit=True) for z in (0.0, high - lid)]
        spine = box((-x, -y, 0.0), (-x + lid, y, high), fit=True)
        pages = box((-x + lid, -y + 0.005, lid), (x - 0.005, y - 0.005, high - lid))
        for mesh, texture in ((merge_meshes([*boards, spine]), cover), (pages, "paper")):
            parts.append(Part(mesh, texture).place((0, 0, bottom), yaw))
        bottom += high
    return parts


def bowl() -> list[Part]:
    """A bowl of fruit."""
    profile = [(0.05, 0.0), (0.10, 0.03), (0.135, 0.075), (0.128, 0.075), (0.09, 0.035), (0.0005, 0.02)]
    parts = [Part(lathe(profile, smooth=True), "terracotta")]
    fruit = (("apple", 0.042, 0.05, 0.0), ("orange", 0.04, -0.03, 0.045), ("apple", 0.04, -0.035, -0.042))
    for texture, radius, x, y in (*fruit, ("orange", 0.038, 0.0, 0.0)):
        arc = np.linspace(-np.pi / 2 + 0.02, np.pi / 2 - 0.02, 10)
        ball = lathe([(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in arc], smooth=True)
        parts.append(Part(ball.translate((x, y, 0.072 if (x, y) != (0.0, 0.0) else 0.125)), texture))
    return parts


def flat_picture(texture: str, width_m: float, height_m: float, depth_m: float = 0.03) -> list[Part]:
    """A picture on a wall behind it (at y = 0), its lower edge at z = 0."""
    left, right = -width_m / 2, width_m / 2
    front = panel((left, -depth_m, height_m), (width_m, 0, 0), (0, 0, -height_m), fit=True)
    return [Part(front, texture), Part(box((left, -depth_m + 0.001, 0), (right, 0, height_m)), "walnut")]


def lying_sheet(texture: str, width_m: float, length_m: float, thickness_m: float) -> list[Part]:
    """A flat object on the floor or a table: newspaper, rug."""
    x, y = width_m / 2, length_m / 2
    return [Part(box((-x, -y, 0), (x, y, thickness_m), fit=True), texture)]


def carton(texture: str, width_m: float, depth_m: float, height_m: float) -> list[Part]:
    """A closed box with its label on every side."""
    return [Part(box((-width_m / 2, -depth_m / 2, 0), (width_m / 2, depth_m / 2, height_m), fit=True), texture)]


def cupboard(
    size_m: tuple[float, float, float], front: str, body: str, fronts: int = 1, top: str | None = None
) -> list[Part]:
    """A body against a wall at y = 0 with `fronts` equal pictures side by side, and a worktop if one is named."""
    width, depth, height = size_m
    parts = [Part(box((-width / 2, -depth, 0), (width / 2, 0, height)), body)]
    step = width / fronts
    for i in range(fronts):
        corner = (-width / 2 + i * step, -depth - 0.004, height - 0.01)
        parts.append(Part(panel(corner, (step, 0, 0), (0, 0, -height + 0.05), fit=True), front))
    if top is not None:
        slab = box((-width / 2 - 0.01, -depth - 0.03, height), (width / 2 + 0.01, 0, height + 0.035))
        parts.append(Part(slab, top))
    return parts


def kettle() -> list[Part]:
    """A steel kettle with a handle over it."""
    body = lathe([(0.085, 0), (0.095, 0.05), (0.085, 0.13), (0.05, 0.18), (0.02, 0.19), (0.0005, 0.2)], smooth=True)
    handle = ring(0.085, 0.009, 0.15, np.pi - 0.15).translate((0, 0, 0.15))
    return [Part(body, "steel"), Part(handle, "rubber")]


def sofa() -> list[Part]:
    """Two seats with arms and two printed cushions; its back is at +y."""
    base = [box((-0.95, -0.42, 0.08), (0.95, 0.42, 0.30)), box((-0.95, 0.22, 0.30), (0.95, 0.42, 0.82))]
    arms = [box((x - 0.1, -0.42, 0.30), (x + 0.1, 0.22, 0.58)) for x in (-0.85, 0.85)]
    seats = [box((x - 0.37, -0.44, 0.30), (x + 0.37, 0.22, 0.44)) for x in (-0.375, 0.375)]
    feet = [box((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.08)) for x in (-0.88, 0.88) for y in (-0.36, 0.36)]
    parts = [
        Part(merge_meshes(base + arms), "sofa_cloth"),
        Part(merge_meshes(seats), "seat_cloth"),
        Part(merge_meshes(feet), "walnut"),
    ]
    for x, yaw, texture in ((-0.5, 14, "plaid"), (0.52, -12, "cushion")):
        cushion = box((-0.2, -0.06, 0), (0.2, 0.06, 0.38), fit=texture == "cushion")
        parts.append(Part(cushion, texture).place((x, 0.1, 0.44), yaw))
    return parts


def television() -> list[Part]:
    """A flat screen on a foot, seen from -y."""
    screen = panel((-0.5, -0.031, 0.68), (1.0, 0, 0), (0, 0, -0.6), fit=True)
    body = [box((-0.5, -0.03, 0.08), (0.5, 0.02, 0.68)), box((-0.2, -0.1, 0), (0.2, 0.1, 0.02))]
    return [
        Part(screen, "screen"),
        Part(merge_meshes([*body, box((-0.04, -0.01, 0.02), (0.04, 0.01, 0.08))]), "rubber"),
    ]


def shelf() -> list[Part]:
    """An open case with four rows of books, against a wall at y = 0."""
    sides = [box((x - 0.012, -0.28, 0), (x + 0.012, 0, 1.8)) for x in (-0.45, 0.45)]
    boards = [box((-0.44, -0.28, z), (0.44, 0, z + 0.024)) for z in (0.06, 0.48, 0.9, 1.32, 1.776)]
    parts = [Part(merge_meshes([*sides, *boards, box((-0.44, -0.012, 0), (0.44, 0, 1.8))]), "cherry")]
    for z, left, right in ((0.084, -0.42, 0.3), (0.504, -0.3, 0.42), (0.924, -0.42, 0.1), (1.344, -0.1, 0.42)):
        row = panel((left, -0.22, z + 0.33), (right - left, 0, 0), (0, 0, -0.33), fit=True)
        block = box((left, -0.219, z), (right, -0.02, z + 0.3))
        parts += [Part(row, "book_row"), Part(block, "paper")]
    return parts


def plant() -> list[Part]:
    """A pot with a bush of bent leaves."""
    profile = [(0.11, 0), (0.155, 0.26), (0.165, 0.26), (0.165, 0.3), (0.145, 0.3), (0.14, 0.25), (0.0005, 0.25)]
    parts = [Part(lathe(profile), "terracotta")]
    leaves = []
    for i in range(26):
        length, rise = 0.26 + 0.05 * (i % 4), 0.12 + 0.16 * ((i * 7) % 5) / 4
        blade = leaf(length, 0.11 + 0.012 * (i % 3), rise)
        leaves.append(blade.rotate_z(2.39996 * i).translate((0, 0, 0.28 + 0.022 * i)))
    stem = lathe([(0.016, 0.25), (0.01, 0.86)], sectors=10)
    return [*parts, Part(merge_meshes(leaves), "leaf"), Part(stem, "bark")]


def lamp() -> list[Part]:
    """A floor lamp with a pleated shade."""
    foot = lathe([(0.15, 0), (0.15, 0.02), (0.02, 0.035), (0.014, 0.05), (0.014, 1.3)], sectors=20)
    shade = lathe([(0.22, 1.25), (0.14, 1.58)], sectors=32)
    lining = lathe([(0.139, 1.58), (0.218, 1.25)], sectors=32)
    return [Part(foot, "steel"), Part(shade, "shade_cloth"), Part(lining, "paper")]


def stool() -> list[Part]:
    """A round upholstered stool on four legs."""
    cushion = lathe([(0.20, 0.33), (0.23, 0.36), (0.23, 0.42), (0.20, 0.45), (0.0005, 0.455)], smooth=True)
    legs = [box((x - 0.02, y - 0.02, 0), (x + 0.02, y + 0.02, 0.34)) for x in (-0.13, 0.13) for y in (-0.13, 0.13)]
    return [Part(cushion, "seat_cloth"), Part(merge_meshes(legs), "cherry")]
