"""Seats and beds, each in its own frame: standing on z = 0, front towards -y."""

from __future__ import annotations

import numpy as np

from gausslite_sim.mesh import box, lathe, merge_meshes
from gausslite_sim.scene_objects import Part
from gausslite_sim.shapes import draped, legs, pillow, rods, tube


def couch(width_m: float, cloth: str, cushions: tuple[str, ...] = (), seats: int = 2) -> list[Part]:
    """A sofa with soft seats and back, cushions leaning in it, and thin wooden legs."""
    half = width_m / 2
    body = [box((-half, -0.4, 0.12), (half, 0.42, 0.30)), box((-half, 0.26, 0.3), (half, 0.42, 0.62))]
    body += [box((x - 0.09, -0.42, 0.12), (x + 0.09, 0.42, 0.56)) for x in (-half - 0.08, half + 0.08)]
    step = width_m / seats
    soft = []
    for i in range(seats):
        x = -half + (i + 0.5) * step
        soft.append(pillow(step, 0.72, 0.17, fit=False).rotate_x(np.pi / 2).translate((x, 0.28, 0.36)))
        soft.append(pillow(step, 0.44, 0.2, fit=False).rotate_x(-0.18).translate((x, 0.2, 0.42)))
    parts = [Part(merge_meshes(body), cloth), Part(merge_meshes(soft), cloth)]
    parts.append(Part(legs(width_m, 0.7, 0.12, 0.03), "dark_wood"))
    for i, texture in enumerate(cushions):
        x = -half + (i + 0.5) * width_m / len(cushions) + 0.06 * (-1) ** i
        cushion = Part(pillow(0.42, 0.42, 0.15), texture).rotate_x(-16)
        parts.append(cushion.place((x, 0.0, 0.44), 12 * (-1) ** i))
    return parts


def armchair(cloth: str, cushion: str | None = None) -> list[Part]:
    """A deep chair on splayed legs."""
    seat = pillow(0.6, 0.6, 0.2, fit=False).rotate_x(np.pi / 2).translate((0, 0.28, 0.4))
    back = pillow(0.66, 0.62, 0.2, fit=False).rotate_x(-0.22).translate((0, 0.2, 0.4))
    arms = [pillow(0.62, 0.34, 0.13, fit=False).rotate_z(np.pi / 2).translate((x, -0.03, 0.3)) for x in (-0.36, 0.36)]
    frame = box((-0.33, -0.28, 0.24), (0.33, 0.3, 0.34))
    parts = [
        Part(merge_meshes([seat, back, *arms, frame]), cloth),
        Part(legs(0.5, 0.46, 0.25, 0.035, 0.05), "light_wood"),
    ]
    if cushion is not None:
        parts.append(Part(pillow(0.38, 0.38, 0.13), cushion).rotate_x(-18).place((0.03, 0.02, 0.5), 8))
    return parts


def office_chair(cloth: str) -> list[Part]:
    """A swivel chair: five feet with castors, a gas column, arms and a netted back."""
    feet = []
    for i in range(5):
        a = 2 * np.pi * i / 5 + 0.3
        end = (0.3 * float(np.cos(a)), 0.3 * float(np.sin(a)), 0.07)
        feet += [
            tube([(0, 0, 0.12), end], 0.02),
            lathe([(0.001, 0), (0.03, 0.01), (0.03, 0.05), (0.001, 0.06)], sectors=10).translate((end[0], end[1], 0)),
        ]
    column = lathe([(0.03, 0.1), (0.03, 0.42)], sectors=12)
    arms = [tube([(x, 0.05, 0.46), (1.1 * x, 0.05, 0.55), (1.1 * x, 0.05, 0.68)], 0.014) for x in (-0.27, 0.27)]
    rests = [box((x - 0.035, -0.14, 0.68), (x + 0.035, 0.14, 0.71)) for x in (-0.3, 0.3)]
    post = tube([(0, 0.18, 0.45), (0, 0.27, 0.5), (0, 0.26, 0.8)], 0.018)
    seat = pillow(0.5, 0.48, 0.1, fit=False).rotate_x(np.pi / 2).translate((0, 0.22, 0.48))
    back = pillow(0.46, 0.54, 0.06, fit=False).rotate_x(-0.12).translate((0, 0.21, 0.56))
    return [
        Part(merge_meshes([*feet, column, *arms, *rests, post]), "black_plastic"),
        Part(merge_meshes([seat, back]), cloth),
    ]


def shell_chair(colour: str, metal: str = "steel") -> list[Part]:
    """A moulded chair on thin metal legs."""
    seat = box((-0.22, -0.22, 0.43), (0.22, 0.2, 0.45), cell_m=0.06)
    back = box((-0.2, -0.01, 0), (0.2, 0.01, 0.36), cell_m=0.06).rotate_x(-0.2).translate((0, 0.2, 0.45))
    frame = [legs(0.36, 0.34, 0.43, 0.022, 0.04), rods([((-0.18, -0.17, 0.3), (0.18, -0.17, 0.3))], 0.008)]
    return [Part(merge_meshes([seat, back]), colour), Part(merge_meshes(frame), metal)]


def spindle_chair(wood: str, pad: str | None = None) -> list[Part]:
    """A country chair: a round seat, turned legs, a back of seven thin rods under a bow."""
    seat = lathe([(0.0005, 0.42), (0.21, 0.42), (0.225, 0.435), (0.21, 0.46), (0.0005, 0.455)], smooth=True)
    stays: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = [
        ((0.13 * u, 0.15, 0.45), (0.17 * u, 0.25, 0.87 - 0.05 * u * u)) for u in np.linspace(-1, 1, 7).tolist()
    ]
    bow = tube([(float(0.2 * u), 0.25, float(0.9 - 0.07 * u * u)) for u in np.linspace(-1, 1, 9)], 0.014)
    struts = rods([((-0.17, -0.15, 0.18), (0.17, -0.15, 0.18)), ((-0.17, 0.15, 0.18), (0.17, 0.15, 0.18))], 0.008)
    parts = [Part(merge_meshes([seat, legs(0.26, 0.26, 0.43, 0.03, 0.05), rods(stays, 0.007), bow, struts]), wood)]
    if pad is not None:
        parts.append(Part(pillow(0.36, 0.36, 0.06).rotate_x(np.pi / 2).translate((0, 0.18, 0.475)), pad))
    return parts


def bar_stool(seat: str) -> list[Part]:
    """A high stool on four thin legs with a foot ring."""
    top = lathe([(0.0005, 0.70), (0.17, 0.70), (0.18, 0.72), (0.17, 0.75), (0.0005, 0.755)], smooth=True)
    corners = [(0.19 * float(np.cos(a)), 0.19 * float(np.sin(a)), 0.26) for a in np.linspace(0, 2 * np.pi, 25)]
    return [Part(top, seat), Part(merge_meshes([legs(0.22, 0.22, 0.7, 0.024, 0.06), tube(corners, 0.008)]), "steel")]


def bench(length_m: float, wood: str, pad: str | None = None) -> list[Part]:
    """A plank on trestles."""
    top = box((-length_m / 2, -0.17, 0.41), (length_m / 2, 0.17, 0.45))
    feet = [box((x - 0.02, -0.14, 0), (x + 0.02, 0.14, 0.41)) for x in (-length_m / 2 + 0.12, length_m / 2 - 0.12)]
    parts = [Part(merge_meshes([top, *feet]), wood)]
    if pad is not None:
        cushion = pillow(length_m - 0.1, 0.32, 0.06, fit=False).rotate_x(np.pi / 2)
        parts.append(Part(cushion.translate((0, 0.16, 0.475)), pad))
    return parts


def ottoman(cloth: str) -> list[Part]:
    """A round stuffed seat."""
    profile = [(0.24, 0.0), (0.29, 0.08), (0.30, 0.2), (0.28, 0.33), (0.2, 0.39), (0.0005, 0.4)]
    return [Part(lathe(profile, smooth=True), cloth)]


def bed(width_m: float, frame: str, cover: str, pillows: tuple[str, ...], throw: str | None = None) -> list[Part]:
    """A bed 2.05 m long, its head at +y: frame, mattress, a cover over the sides, pillows, a throw at its foot."""
    half = width_m / 2
    head = box((-half - 0.06, 0.98, 0.0), (half + 0.06, 1.04, 1.0))
    rails = [box((x - 0.02, -1.02, 0.14), (x + 0.02, 1.0, 0.3)) for x in (-half - 0.02, half + 0.02)]
    rails += [box((-half, -1.04, 0.14), (half, -1.0, 0.3)), legs(width_m - 0.1, 1.9, 0.14, 0.06)]
    mattress = box((-half, -1.0, 0.28), (half, 0.98, 0.5))
    parts = [Part(merge_meshes([head, *rails]), frame), Part(mattress, "linen")]
    parts.append(Part(draped(width_m, 1.45, 0.24).translate((0, -0.28, 0.515)), cover))
    for i, texture in enumerate(pillows):
        x = -half + (i % 2 + 0.5) * half
        lean, y, z = (-30, 0.72, 0.52) if i < 2 else (-38, 0.52, 0.54)
        size = (0.66 * half / 0.8, 0.42) if i < 2 else (0.42, 0.42)
        leaning = Part(pillow(*size, 0.15), texture).rotate_x(lean)
        parts.append(leaning.place((x * (1 if i < 2 else 0.5), y, z), 3 * i - 4))
    if throw is not None:
        parts.append(Part(draped(width_m + 0.06, 0.5, 0.3).translate((0, -0.72, 0.55)), throw))
    return parts
