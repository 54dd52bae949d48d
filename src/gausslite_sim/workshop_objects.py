"""Tools and other workshop objects, each standing or lying on z = 0."""

from __future__ import annotations

import numpy as np

from gausslite_sim.mesh import box, lathe, merge_meshes, panel, ring
from gausslite_sim.scene_objects import Part
from gausslite_sim.shapes import rods, tube


def toolbox(colour: str) -> list[Part]:
    """A steel box with a lid, a label and a bar to carry it by."""
    body = merge_meshes([box((-0.22, -0.1, 0), (0.22, 0.1, 0.16)), box((-0.2, -0.09, 0.16), (0.2, 0.09, 0.2))])
    handle = tube([(-0.12, 0, 0.2), (-0.12, 0, 0.26), (0.12, 0, 0.26), (0.12, 0, 0.2)], 0.009)
    clasps = [box((x - 0.02, -0.106, 0.11), (x + 0.02, -0.1, 0.17)) for x in (-0.13, 0.13)]
    label = panel((-0.07, -0.1012, 0.13), (0.14, 0, 0), (0, 0, -0.1), fit=True)
    return [Part(body, colour), Part(merge_meshes([handle, *clasps]), "steel"), Part(label, "packet")]


def drill(colour: str) -> list[Part]:
    """A cordless drill that stands on its battery."""
    body = lathe([(0.0005, 0), (0.035, 0.005), (0.038, 0.12), (0.025, 0.16), (0.0005, 0.165)], smooth=True)
    grip = box((-0.02, -0.025, 0.05), (0.02, 0.025, 0.17)).rotate_x(0.15)
    chuck = lathe([(0.022, 0.16), (0.012, 0.2), (0.004, 0.2), (0.004, 0.28), (0.0005, 0.29)])
    battery = box((-0.04, -0.06, 0), (0.04, 0.06, 0.055))
    lying = [mesh.rotate_x(np.pi / 2).translate((0, 0.09, 0.19)) for mesh in (body, chuck)]
    return [Part(merge_meshes([lying[0], grip]), colour), Part(merge_meshes([lying[1], battery]), "black_plastic")]


def hammer() -> list[Part]:
    """Lying on its side."""
    head = [box((-0.055, -0.014, 0.0), (0.055, 0.014, 0.028))]
    return [
        Part(merge_meshes(head), "steel"),
        Part(tube([(0, 0, 0.014), (0, -0.15, 0.014), (0, -0.3, 0.016)], 0.013), "light_wood"),
    ]


def saw(length_m: float = 0.5) -> list[Part]:
    """Hanging on a wall at y = 0, its grip on the left."""
    blade = box((-0.1, -0.012, -0.05), (length_m - 0.1, -0.008, 0.05))
    grip = [ring(0.06, 0.015, 0.4, 2 * np.pi - 0.4).translate((-0.16, -0.015, 0))]
    return [Part(blade, "aluminium"), Part(merge_meshes(grip), "light_wood")]


def spanners(count: int = 5) -> list[Part]:
    """A row of spanners that hang on a wall at y = 0."""
    pieces = []
    for i in range(count):
        x, length = 0.05 * i, 0.12 + 0.025 * i
        pieces.append(box((x - 0.006, -0.012, -length), (x + 0.006, -0.006, 0)))
        pieces += [ring(0.013, 0.005, 0.5, 2 * np.pi - 0.5).translate((x, -0.01, z)) for z in (0.01, -length - 0.01)]
    return [Part(merge_meshes(pieces), "steel")]


def ladder(height_m: float = 2.0) -> list[Part]:
    """Leaning back towards a wall behind it."""
    lean = 0.22 * height_m
    sides = [((x, 0.0, 0.0), (0.85 * x, lean, height_m)) for x in (-0.21, 0.21)]
    steps = [
        ((-0.21 * (1 - 0.15 * t), lean * t, height_m * t), (0.21 * (1 - 0.15 * t), lean * t, height_m * t))
        for t in np.linspace(0.12, 0.92, 7).tolist()
    ]
    return [Part(merge_meshes([rods(sides, 0.02), rods(steps, 0.014)]), "aluminium")]


def broom() -> list[Part]:
    """Standing on its bristles, leaning back."""
    stick = tube([(0, 0, 0.12), (0, 0.3, 1.4)], 0.012)
    head = [box((-0.15, -0.03, 0.08), (0.15, 0.03, 0.12))]
    bristles = rods(
        [((0.012 * i - 0.144, 0.01 * (-1) ** i, 0.085), (0.013 * i - 0.156, 0.016 * (-1) ** i, 0)) for i in range(25)],
        0.004,
    )
    return [Part(merge_meshes([stick, *head]), "light_wood"), Part(bristles, "straw")]


def wheel() -> list[Part]:
    """A bicycle's wheel in the x-z plane: tyre, rim, hub and spokes."""
    tyre = ring(0.33, 0.018, 0, 2 * np.pi).translate((0, 0, 0.35))
    rim = ring(0.305, 0.008, 0, 2 * np.pi).translate((0, 0, 0.35))
    turns = np.linspace(0, 2 * np.pi, 19)[:-1]
    ends = [(0.3 * float(np.cos(a)), 0.0, 0.35 + 0.3 * float(np.sin(a))) for a in turns]
    spokes = rods([((0.0, 0.02 * (-1) ** i, 0.35), end) for i, end in enumerate(ends)], 0.0022)
    hub = lathe([(0.0005, -0.04), (0.02, -0.04), (0.02, 0.04), (0.0005, 0.04)], sectors=12).rotate_x(np.pi / 2)
    return [Part(tyre, "rubber"), Part(merge_meshes([rim, spokes, hub.translate((0, 0, 0.35))]), "steel")]


def helmet(colour: str) -> list[Part]:
    """A hard hat."""
    dome = lathe([(0.17, 0.0), (0.165, 0.008), (0.13, 0.02), (0.125, 0.08), (0.08, 0.13), (0.0005, 0.145)], smooth=True)
    ridge = box((-0.012, -0.1, 0.06), (0.012, 0.1, 0.15))
    return [Part(merge_meshes([dome, ridge]), colour)]
