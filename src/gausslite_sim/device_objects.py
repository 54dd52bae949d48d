"""Devices: screens, keyboards, lamps, printers. Each stands on z = 0 with its front towards -y."""

from __future__ import annotations

import numpy as np

from gausslite_sim.mesh import Vector, box, lathe, merge_meshes, panel, ring
from gausslite_sim.scene_objects import Part
from gausslite_sim.shapes import pillow, rods, sagging, tube


def laptop(screen: str) -> list[Part]:
    """An open laptop, 0.33 m wide, with its lid leaning back."""
    base = box((-0.165, -0.12, 0), (0.165, 0.12, 0.016))
    keys = panel((-0.15, 0.09, 0.0165), (0.3, 0, 0), (0, -0.12, 0), fit=True)
    pad = panel((-0.05, -0.045, 0.0165), (0.1, 0, 0), (0, -0.065, 0), fit=True)
    lid = box((-0.165, 0, 0), (0.165, 0.008, 0.225))
    shown = panel((-0.155, -0.0008, 0.215), (0.31, 0, 0), (0, 0, -0.2), fit=True)
    lid, shown = (mesh.rotate_x(-0.32).translate((0, 0.12, 0.014)) for mesh in (lid, shown))
    return [Part(merge_meshes([base, lid, pad]), "aluminium"), Part(keys, "keys"), Part(shown, screen)]


def keyboard() -> list[Part]:
    """A full-size keyboard with a cable, tilted towards its user."""
    body = box((-0.22, -0.07, 0), (0.22, 0.07, 0.018))
    keys = panel((-0.212, 0.063, 0.0185), (0.424, 0, 0), (0, -0.126, 0), fit=True)
    body, keys = (mesh.rotate_x(0.07).translate((0, 0, 0.006)) for mesh in (body, keys))
    cable = tube([(0, 0.07, 0.012), (0.02, 0.14, 0.004), (-0.05, 0.24, 0.004), (0.03, 0.34, 0.004)], 0.003)
    return [Part(merge_meshes([body, cable]), "black_plastic"), Part(keys, "keys")]


def mouse() -> list[Part]:
    """A mouse with its cable."""
    hump = pillow(0.062, 0.11, 0.04, fit=False).rotate_x(np.pi / 2).translate((0, 0.055, 0.016))
    cable = tube([(0, 0.05, 0.01), (-0.02, 0.12, 0.004), (0.03, 0.2, 0.004)], 0.0025)
    return [Part(merge_meshes([hump, cable]), "black_plastic")]


def monitor(screen: str, width_m: float = 0.6) -> list[Part]:
    """A flat screen on a thin foot."""
    high, x = 0.58 * width_m, width_m / 2
    body = [box((-x, -0.015, 0.12), (x, 0.015, 0.12 + high)), box((-0.03, 0.01, 0.01), (0.03, 0.03, 0.3))]
    body.append(box((-0.12, -0.09, 0), (0.12, 0.09, 0.012)))
    shown = panel((-x + 0.008, -0.0155, 0.112 + high), (width_m - 0.016, 0, 0), (0, 0, 0.03 - high), fit=True)
    return [Part(merge_meshes(body), "black_plastic"), Part(shown, screen)]


def printer() -> list[Part]:
    """A desk printer with paper in its trays."""
    body = box((-0.22, -0.18, 0.03), (0.22, 0.18, 0.24))
    slot = panel((-0.2, -0.181, 0.22), (0.4, 0, 0), (0, 0, -0.18), fit=True)
    tray = box((-0.13, -0.34, 0.05), (0.13, -0.16, 0.058))
    sheet = panel((-0.105, -0.17, 0.0605), (0.21, 0, 0), (0, -0.15, 0), fit=True)
    feed = panel((-0.105, 0.14, 0.42), (0.21, 0, 0), (0, -0.05, -0.19), fit=True)
    glass = panel((-0.18, 0.1, 0.2405), (0.36, 0, 0), (0, -0.24, 0), fit=True)
    return [
        Part(merge_meshes([body, tray]), "white_plastic"),
        Part(slot, "printer_front"),
        Part(merge_meshes([sheet, feed]), "page"),
        Part(glass, "black_glass"),
    ]


def desk_lamp(colour: str) -> list[Part]:
    """A desk lamp: a thin arm with two joints, a conical shade and a cable."""
    foot = lathe([(0.0005, 0.0), (0.085, 0.0), (0.085, 0.02), (0.0005, 0.024)])
    arm = tube([(0, 0, 0.02), (0, 0.05, 0.2), (0, 0.09, 0.32)], 0.007)
    upper = tube([(0, 0.09, 0.32), (0, -0.04, 0.42), (0, -0.16, 0.46)], 0.007)
    shade = lathe([(0.075, -0.1), (0.03, 0.0), (0.0005, 0.005)], smooth=True).rotate_x(0.35).translate((0, -0.2, 0.47))
    lining = lathe([(0.0005, 0.0), (0.028, -0.004), (0.073, -0.1)]).rotate_x(0.35).translate((0, -0.2, 0.47))
    cable = tube([(0, 0.08, 0.004), (0.07, 0.14, 0.004), (0.03, 0.24, 0.004)], 0.003)
    return [
        Part(merge_meshes([foot, shade]), colour),
        Part(merge_meshes([arm, upper, cable]), "black_plastic"),
        Part(lining, "glow"),
    ]


def floor_lamp(shade: str) -> list[Part]:
    """A floor lamp: a tripod of thin rods under a cloth drum."""
    directions = [(float(np.cos(a)), float(np.sin(a))) for a in (0.5, 2.6, 4.7)]
    feet: list[tuple[Vector, Vector]] = [((0.28 * x, 0.28 * y, 0.0), (0.02 * x, 0.02 * y, 1.25)) for x, y in directions]
    drum = lathe([(0.21, 1.2), (0.21, 1.5)], sectors=36)
    inside = lathe([(0.208, 1.5), (0.208, 1.2)], sectors=36)
    return [Part(rods(feet, 0.012), "light_wood"), Part(drum, shade), Part(inside, "glow")]


def pendant(colour: str, drop_m: float) -> list[Part]:
    """A lamp on a cable, hanging from z = 0 down."""
    cable = tube([(0, 0, 0), (0, 0, -drop_m)], 0.005)
    shade = lathe([(0.2, -drop_m - 0.2), (0.17, -drop_m - 0.08), (0.05, -drop_m), (0.0005, -drop_m)], smooth=True)
    lining = lathe([(0.0005, -drop_m - 0.01), (0.165, -drop_m - 0.085), (0.197, -drop_m - 0.2)])
    return [Part(cable, "black_plastic"), Part(shade, colour), Part(lining, "glow")]


def speaker(wood: str) -> list[Part]:
    """A loudspeaker box with two cones."""
    body = box((-0.1, -0.11, 0), (0.1, 0.11, 0.32))
    cones = []
    for z, radius in ((0.11, 0.075), (0.25, 0.04)):
        cone = lathe([(radius, 0.0), (0.3 * radius, -0.02), (0.0005, -0.012)], smooth=True, sectors=22)
        cones.append(cone.rotate_x(np.pi / 2).translate((0, -0.112, z)))
    return [Part(body, wood), Part(merge_meshes(cones), "rubber")]


def phone(screen: str) -> list[Part]:
    """A phone lying on its back."""
    shown = panel((-0.036, 0.073, 0.0092), (0.072, 0, 0), (0, -0.146, 0), fit=True)
    return [Part(box((-0.038, -0.076, 0), (0.038, 0.076, 0.009)), "black_plastic"), Part(shown, screen)]


def headphones() -> list[Part]:
    """Headphones lying on a table: a headband and two cushions."""
    headband = ring(0.085, 0.008, 0.0, np.pi).rotate_x(-1.35).translate((0, 0.02, 0.03))
    cups = [
        lathe([(0.0005, 0), (0.04, 0.0), (0.045, 0.02), (0.0005, 0.032)], smooth=True).translate((x, 0.0, 0.004))
        for x in (-0.085, 0.085)
    ]
    return [Part(headband, "steel"), Part(merge_meshes(cups), "leather")]


def projector() -> list[Part]:
    """A white case with a lens and a cable."""
    body = box((-0.16, -0.12, 0.02), (0.16, 0.12, 0.12))
    lens = lathe([(0.04, 0), (0.045, 0.03), (0.03, 0.03), (0.02, 0.01), (0.0005, 0.012)]).rotate_x(np.pi / 2)
    grille = panel((-0.15, -0.121, 0.11), (0.16, 0, 0), (0, 0, -0.08), fit=True)
    cable = tube([(0, 0.12, 0.05), (0.03, 0.25, 0.006), (-0.1, 0.4, 0.006), (0.05, 0.6, 0.006)], 0.004)
    return [
        Part(body, "white_plastic"),
        Part(merge_meshes([lens.translate((0.08, -0.12, 0.07)), cable]), "black_plastic"),
        Part(grille, "printer_front"),
    ]


def fan() -> list[Part]:
    """A table fan: a wire cage in front of four blades."""
    stand = [lathe([(0.0005, 0), (0.12, 0), (0.12, 0.02), (0.02, 0.04), (0.018, 0.22)])]
    cage = [ring(r, 0.003, 0, 2 * np.pi).translate((0, -0.05, 0.36)) for r in (0.16, 0.11, 0.06)]
    spokes: list[tuple[Vector, Vector]] = [
        ((0.0, -0.06, 0.36), (0.16 * float(np.cos(a)), -0.05, 0.36 + 0.16 * float(np.sin(a))))
        for a in np.linspace(0, 2 * np.pi, 17)[:-1]
    ]
    wing = box((0.02, -0.004, -0.04), (0.14, 0.004, 0.04)).rotate_x(0.3)
    wings = [wing.rotate_y(k * np.pi / 2).translate((0, -0.01, 0.36)) for k in range(4)]
    return [Part(merge_meshes([*stand, *cage, rods(spokes, 0.002)]), "steel"), Part(merge_meshes(wings), "blue_paint")]


def cable_run(start_m: Vector, end_m: Vector, sag_m: float) -> list[Part]:
    """A black cable between two points."""
    return [Part(sagging(start_m, end_m, sag_m, 0.006), "black_plastic")]
