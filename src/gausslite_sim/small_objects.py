"""Small objects for tables, shelves and floors. Each stands on z = 0 with its front towards -y."""

from __future__ import annotations

import numpy as np

from gausslite_sim.mesh import box, lathe, merge_meshes, panel, ring
from gausslite_sim.scene_objects import Part
from gausslite_sim.shapes import ball, blade, rods, shell, tube


def cup(picture: str) -> list[Part]:
    """A printed mug, 9.5 cm high, with a handle at +x."""
    outside = lathe([(0.036, 0.0), (0.04, 0.01), (0.041, 0.095)], fit=True)
    inside = lathe([(0.041, 0.095), (0.037, 0.095), (0.034, 0.01), (0.0005, 0.01)])
    handle = ring(0.028, 0.006, -np.pi / 2, np.pi / 2).translate((0.038, 0, 0.05))
    return [Part(outside, picture), Part(merge_meshes([inside, handle]), "glaze")]


def bottle(label: str, glass: str, height_m: float = 0.3) -> list[Part]:
    """A shouldered bottle with a printed label."""
    h = height_m
    body = [
        (0.0005, 0.0),
        (0.036, 0.0),
        (0.038, 0.02),
        (0.038, 0.6 * h),
        (0.028, 0.72 * h),
        (0.014, 0.8 * h),
        (0.013, 0.95 * h),
    ]
    cap = lathe([(0.015, 0.93 * h), (0.015, h), (0.0005, h)], sectors=16)
    wrap = lathe([(0.0388, 0.15 * h), (0.0388, 0.52 * h)], fit=True)
    return [Part(lathe(body, smooth=True), glass), Part(cap, "brass"), Part(wrap, label)]


def round_vase(picture: str) -> list[Part]:
    """A bellied vase with dry twigs in it."""
    profile = [(0.05, 0.0), (0.085, 0.06), (0.092, 0.12), (0.07, 0.19), (0.035, 0.23), (0.045, 0.26)]
    twigs = []
    for i in range(9):
        a, lean = 2.4 * i, 0.05 + 0.02 * (i % 4)
        tip = (lean * float(np.cos(a)) * 2.2, lean * float(np.sin(a)) * 2.2, 0.5 + 0.04 * (i % 3))
        twigs.append(tube([(0, 0, 0.12), (0.4 * tip[0], 0.4 * tip[1], 0.34), tip], 0.0025, 5))
        twigs.append(ball(0.013, 1.3, 8).translate(tip))
    return [Part(lathe(profile, smooth=True, fit=True), picture), Part(merge_meshes(twigs), "straw")]


def teapot(colour: str) -> list[Part]:
    """A round teapot with a spout, a lid and a handle."""
    body = lathe([(0.05, 0), (0.085, 0.04), (0.09, 0.08), (0.06, 0.13), (0.02, 0.145), (0.0005, 0.146)], smooth=True)
    spout = tube([(0.075, 0, 0.05), (0.12, 0, 0.08), (0.14, 0, 0.13)], 0.013)
    handle = ring(0.05, 0.007, np.pi / 2, 3 * np.pi / 2).translate((-0.075, 0, 0.08))
    return [Part(merge_meshes([body, spout, handle, ball(0.014).translate((0, 0, 0.155))]), colour)]


def fruit_bowl(glaze: str, fruit: tuple[str, ...]) -> list[Part]:
    """A wide bowl with a heap of fruit."""
    rim = [(0.05, 0.0), (0.11, 0.03), (0.15, 0.08), (0.144, 0.08), (0.10, 0.036), (0.0005, 0.02)]
    parts = [Part(lathe(rim, smooth=True), glaze)]
    for i, texture in enumerate(fruit):
        a, r = 2.4 * i, 0.028 * np.sqrt(i)
        spot = (float(r * np.cos(a)), float(r * np.sin(a)), 0.075 + 0.02 * (i % 2) + (0.03 if i == 0 else 0.0))
        parts.append(Part(ball(0.038, 0.95, 14).translate(spot), texture))
    return parts


def plate(glaze: str) -> list[Part]:
    """A dinner plate."""
    profile = [(0.0005, 0.0), (0.07, 0.0), (0.12, 0.018), (0.118, 0.02), (0.07, 0.006), (0.0005, 0.006)]
    return [Part(lathe(profile, fit=True), glaze)]


def pot(colour: str) -> list[Part]:
    """A cooking pot with a lid and two handles."""
    body = lathe([(0.0005, 0), (0.11, 0.0), (0.115, 0.14), (0.118, 0.142), (0.05, 0.16), (0.0005, 0.162)])
    handles = [ring(0.03, 0.006, -np.pi / 2, np.pi / 2).translate((0.112, 0, 0.1))]
    handles.append(ring(0.03, 0.006, np.pi / 2, 3 * np.pi / 2).translate((-0.112, 0, 0.1)))
    return [Part(body, colour), Part(merge_meshes([*handles, ball(0.016).translate((0, 0, 0.175))]), "black_plastic")]


def jar(label: str) -> list[Part]:
    """A preserve jar with a checked lid."""
    body = lathe([(0.0005, 0), (0.04, 0.0), (0.042, 0.09), (0.034, 0.105)], fit=True)
    return [Part(body, label), Part(lathe([(0.037, 0.1), (0.037, 0.12), (0.0005, 0.121)]), "gingham")]


def basket(weave: str, filling: str, radius_m: float = 0.2, height_m: float = 0.26) -> list[Part]:
    """A woven basket with something soft in it."""
    side = lathe([(0.8 * radius_m, 0), (radius_m, height_m), (0.96 * radius_m, height_m), (0.8 * radius_m, 0.02)])
    heap = lathe(
        [(0.92 * radius_m, 0.8 * height_m), (0.6 * radius_m, 1.08 * height_m), (0.0005, 1.12 * height_m)], smooth=True
    )
    grips = [ring(0.06, 0.012, 0, np.pi).translate((0, s * radius_m, height_m - 0.01)) for s in (-1, 1)]
    return [Part(merge_meshes([side, *grips]), weave), Part(heap, filling)]


def shoes(upper: str, sole: str = "white_plastic") -> list[Part]:
    """A pair of shoes on the floor."""
    parts = []
    for x, y, yaw in ((-0.065, 0.0, 4), (0.07, -0.05, -15)):
        top = shell(0.28, 0.1, (0.09, 0.105, 0.1, 0.075, 0.055, 0.05, 0.03)).translate((0, 0, 0.022))
        foot = shell(0.29, 0.106, (0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.02))
        laces = rods(
            [
                ((-0.03, 0.02 - 0.025 * i, 0.112 - 0.011 * i), (0.03, 0.01 - 0.025 * i, 0.112 - 0.011 * i))
                for i in range(4)
            ],
            0.003,
        )
        parts += [Part(top, upper).place((x, y, 0), yaw), Part(merge_meshes([foot, laces]), sole).place((x, y, 0), yaw)]
    return parts


def pen_cup(colour: str) -> list[Part]:
    """A cup of pens."""
    tips = [(0.035 * float(np.cos(a)), 0.035 * float(np.sin(a)), 0.17) for a in np.linspace(0, 5.5, 6)]
    pens = rods([((0.0, 0.0, 0.02), tip) for tip in tips], 0.004)
    return [
        Part(lathe([(0.035, 0), (0.038, 0.1), (0.035, 0.1), (0.033, 0.01), (0.0005, 0.01)]), colour),
        Part(pens, "paint_red"),
    ]


def desk_clock(face: str) -> list[Part]:
    """A round alarm clock on two feet."""
    case = (
        lathe([(0.0005, 0.0), (0.06, 0.0), (0.06, 0.05), (0.052, 0.05)]).rotate_x(np.pi / 2).translate((0, 0.02, 0.075))
    )
    dial = panel((-0.054, -0.0305, 0.129), (0.108, 0, 0), (0, 0, -0.108), fit=True)
    feet = rods([((-0.04, 0, 0.03), (-0.055, 0, 0)), ((0.04, 0, 0.03), (0.055, 0, 0))], 0.005)
    bells = [ball(0.02, 0.7, 12).translate((x, 0, 0.14)) for x in (-0.03, 0.03)]
    return [Part(merge_meshes([case, feet, *bells]), "brass"), Part(dial, face)]


def wall_clock(face: str) -> list[Part]:
    """A round clock on a wall at y = 0, its centre at z = 0."""
    rim = lathe([(0.0005, 0.003), (0.17, 0.003), (0.17, 0.04), (0.155, 0.04)]).rotate_x(np.pi / 2)
    return [
        Part(rim, "black_plastic"),
        Part(panel((-0.125, -0.0385, 0.125), (0.25, 0, 0), (0, 0, -0.25), fit=True), face),
    ]


def candles() -> list[Part]:
    """Three on a tray."""
    tray = lathe([(0.0005, 0), (0.12, 0), (0.125, 0.012), (0.118, 0.008), (0.0005, 0.008)])
    sticks = [
        lathe([(r, 0.008), (r, h), (0.0005, h + 0.004)], sectors=16).translate((x, y, 0))
        for x, y, r, h in ((-0.05, 0.02, 0.03, 0.14), (0.045, 0.03, 0.034, 0.09), (0.01, -0.055, 0.026, 0.19))
    ]
    return [Part(tray, "brass"), Part(merge_meshes(sticks), "wax")]


def sheaf(picture: str, width_m: float = 0.21, length_m: float = 0.297, height_m: float = 0.012) -> list[Part]:
    """Paper, a magazine or a closed book lying flat."""
    x, y = width_m / 2, length_m / 2
    top = panel((-x, y, height_m + 0.0004), (width_m, 0, 0), (0, -length_m, 0), fit=True)
    return [Part(top, picture), Part(box((-x, -y, 0), (x, y, height_m)), "paper")]


def crate(wood: str, width_m: float = 0.5, depth_m: float = 0.35, height_m: float = 0.28) -> list[Part]:
    """An open crate of slats."""
    x, y = width_m / 2, depth_m / 2
    slats = [box((-x, -y, 0), (x, y, 0.012))]
    for z in np.linspace(0.02, height_m - 0.07, 3).tolist():
        slats += [box((-x, s * y - 0.006, z), (x, s * y + 0.006, z + 0.065)) for s in (-1, 1)]
        slats += [box((s * x - 0.006, -y, z), (s * x + 0.006, y, z + 0.065)) for s in (-1, 1)]
    return [Part(merge_meshes(slats), wood)]


def bucket(colour: str) -> list[Part]:
    """A pail with a wire handle."""
    pail = lathe([(0.1, 0), (0.14, 0.27), (0.145, 0.27), (0.135, 0.26), (0.1, 0.01), (0.0005, 0.01)])
    return [Part(pail, colour), Part(ring(0.14, 0.004, 0.1, np.pi - 0.1).translate((0, 0, 0.26)), "steel")]


def paint_can(label: str) -> list[Part]:
    """A tin with a label and drips."""
    tin = lathe([(0.0005, 0), (0.083, 0), (0.083, 0.19), (0.076, 0.19), (0.074, 0.18), (0.0005, 0.18)])
    return [Part(tin, "steel"), Part(lathe([(0.0838, 0.02), (0.0838, 0.165)], fit=True), label)]


def snake_plant(potting: str, leaf: str) -> list[Part]:
    """Upright blades in a pot."""
    pot_profile = [(0.09, 0), (0.12, 0.2), (0.125, 0.22), (0.11, 0.22), (0.105, 0.19), (0.0005, 0.19)]
    blades = [
        blade(0.45 + 0.12 * (i % 4), 0.055, 0.06 + 0.03 * (i % 3), 0.6)
        .rotate_z(2.4 * i)
        .translate((0.05 * float(np.cos(2.4 * i)), 0.05 * float(np.sin(2.4 * i)), 0.18))
        for i in range(14)
    ]
    return [Part(lathe(pot_profile), potting), Part(merge_meshes(blades), leaf)]


def fern(potting: str, leaf: str, size: float = 1.0) -> list[Part]:
    """Many thin arching fronds in a small pot."""
    fronds = []
    for i in range(30):
        reach = size * (0.16 + 0.03 * (i % 5))
        frond = blade(size * (0.16 + 0.035 * (i % 4)), size * 0.045, reach, 0.4)
        fronds.append(frond.rotate_z(2.39996 * i).translate((0, 0, 0.11 * size)))
    profile = [(0.06 * size, 0), (0.08 * size, 0.12 * size), (0.07 * size, 0.12 * size), (0.0005, 0.1 * size)]
    return [Part(lathe(profile), potting), Part(merge_meshes(fronds), leaf)]


def little_tree(potting: str, leaf: str) -> list[Part]:
    """A thin trunk with three branches and a crown of leaves, 1.7 m high."""
    trunk = tube([(0, 0, 0.25), (0.02, 0.01, 0.8), (-0.03, 0.02, 1.2), (0.0, 0.0, 1.5)], 0.016)
    branches = [
        tube([(-0.02, 0.01, z), (x, y, z + 0.3)], 0.009)
        for x, y, z in ((0.28, 0.1, 0.9), (-0.25, 0.18, 1.05), (0.05, -0.28, 1.1))
    ]
    tips = ((0.28, 0.1, 1.2), (-0.25, 0.18, 1.35), (0.05, -0.28, 1.4), (0.0, 0.0, 1.5), (0.1, 0.1, 1.32))
    leaves = [
        blade(0.13 + 0.03 * (i % 3), 0.07, 0.12, 0.5)
        .rotate_z(2.4 * i + k)
        .translate((x + 0.07 * float(np.cos(3.1 * i)), y + 0.07 * float(np.sin(3.1 * i)), z - 0.12 + 0.02 * (i % 9)))
        for k, (x, y, z) in enumerate(tips)
        for i in range(16)
    ]
    profile = [(0.13, 0), (0.17, 0.28), (0.18, 0.3), (0.16, 0.3), (0.15, 0.26), (0.0005, 0.26)]
    return [
        Part(lathe(profile), potting),
        Part(merge_meshes([trunk, *branches]), "bark"),
        Part(merge_meshes(leaves), leaf),
    ]
