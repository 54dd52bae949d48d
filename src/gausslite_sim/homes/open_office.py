"""Home 5, an open office: four desks in two islands, swivel chairs, cables, a printer corner, a whiteboard."""

from __future__ import annotations

import numpy as np

from gausslite_sim import device_objects as devices
from gausslite_sim import fabric_textures, furniture, textures
from gausslite_sim import seating_objects as seating
from gausslite_sim import small_objects as small
from gausslite_sim import table_objects as tables
from gausslite_sim.lighting import Lamp, Lighting
from gausslite_sim.materials import Painter, Palette, common_painters
from gausslite_sim.room import Room
from gausslite_sim.scene_objects import Item, Part
from gausslite_sim.shapes import draped

LIGHTING = Lighting(
    (
        Lamp((1.8, 2.4, 2.75), 0.4, (0.96, 0.98, 1.0)),
        Lamp((4.6, 2.4, 2.75), 0.4, (0.96, 0.98, 1.0)),
        Lamp((3.2, 0.4, 1.9), 0.5, (0.88, 0.95, 1.06)),
    ),
    ambient=0.24,
    bounce=0.65,
)
_TOP_M = 0.73
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((0.8, 1.0, 1.55), (1.9, 2.4, 0.75)),
        ((1.8, 0.8, 1.50), (1.9, 2.3, 0.8)),
        ((3.0, 1.0, 1.55), (1.9, 2.4, 0.8)),
        ((3.3, 2.0, 1.50), (1.9, 2.5, 0.8)),
        ((3.3, 3.2, 1.50), (1.8, 2.5, 0.7)),
        ((2.6, 4.1, 1.50), (1.9, 2.6, 0.7)),
        ((1.2, 4.2, 1.55), (2.0, 2.5, 0.7)),
        ((2.8, 4.2, 1.55), (4.6, 2.5, 0.7)),
        ((3.5, 3.4, 1.50), (4.8, 2.4, 0.7)),
        ((3.4, 2.0, 1.50), (6.2, 3.6, 0.9)),
        ((3.6, 1.2, 1.50), (6.1, 4.1, 0.9)),
    ),
    (
        ((3.4, 3.4, 1.50), (6.1, 4.2, 0.9)),
        ((4.6, 3.9, 1.50), (6.2, 4.2, 0.9)),
        ((5.2, 3.9, 1.45), (6.2, 4.3, 0.8)),
        ((5.6, 3.7, 1.50), (6.3, 2.6, 0.9)),
        ((5.8, 3.4, 1.50), (4.8, 2.4, 0.7)),
        ((6.1, 1.6, 1.50), (4.4, 2.4, 0.7)),
        ((5.2, 0.8, 1.50), (4.3, 2.6, 0.6)),
        ((3.4, 0.9, 1.50), (0.2, 2.4, 1.2)),
    ),
    (
        ((0.6, 4.0, 1.90), (1.8, 2.6, 0.6)),
        ((0.65, 1.4, 1.30), (1.8, 2.3, 0.75)),
        ((1.3, 0.55, 1.35), (1.75, 2.3, 0.8)),
        ((2.4, 1.15, 1.95), (1.7, 2.3, 0.72)),
        ((3.1, 1.6, 1.10), (1.8, 2.4, 0.75)),
        ((3.3, 4.1, 1.05), (4.6, 2.8, 0.55)),
        ((3.35, 1.5, 1.95), (4.6, 2.0, 0.5)),
        ((5.9, 1.0, 1.90), (4.5, 2.4, 0.5)),
        ((5.8, 2.9, 1.15), (6.1, 4.5, 0.8)),
        ((5.2, 3.9, 1.90), (6.1, 4.6, 0.8)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 6.6 x 4.9 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(6.6, 4.9, 2.9, rng)
    screens = ("code", "slides", "code", "slides")
    for i, (x, y, yaw) in enumerate(((1.8, 2.07, 0), (1.8, 2.83, 180), (4.6, 2.07, 0), (4.6, 2.83, 180)), 1):
        side = 1 if yaw == 0 else -1
        room.place(
            f"desk_{i}",
            tables.desk(1.6, "light_wood" if i < 3 else "white_plastic", "aluminium", "drawers"),
            x,
            y,
            0,
            yaw,
        )
        room.place_jittered(
            f"monitor_{i}", devices.monitor(screens[i - 1]), x - 0.1 * side, y + 0.2 * side, _TOP_M, yaw + 5
        )
        room.place_jittered(f"keyboard_{i}", devices.keyboard(), x - 0.12 * side, y - 0.14 * side, _TOP_M, yaw)
        room.place_jittered(f"mouse_{i}", devices.mouse(), x + 0.22 * side, y - 0.14 * side, _TOP_M, yaw)
        room.place_jittered(
            f"chair_{i}",
            seating.office_chair("net" if i % 2 else "main_cloth"),
            x - 0.1 * side,
            y - 0.72 * side,
            0,
            180 + yaw + 14 * i,
        )
    room.place_jittered("mug_1", small.cup("mug_print"), 2.3, 1.95, _TOP_M, 30)
    room.place_jittered("laptop", devices.laptop("code"), 1.22, 1.98, _TOP_M, 16)
    room.place_jittered("papers_1", small.sheaf("page"), 2.42, 2.2, _TOP_M, -14)
    room.place("plant_1", small.fern("terracotta", "leaf", 0.9), 1.12, 2.28, _TOP_M)
    room.place_jittered("pen_cup", small.pen_cup("accent_glaze"), 2.2, 2.26, _TOP_M)
    room.place_jittered("headphones", devices.headphones(), 1.2, 2.75, _TOP_M, 200)
    room.place_jittered("bottle", small.bottle("bottle_label", "green_glass", 0.24), 2.4, 2.72, _TOP_M)
    room.place_jittered("phone", devices.phone("phone_screen"), 5.15, 2.0, _TOP_M, 30)
    room.place_jittered("mug_2", small.cup("mug_dots"), 4.1, 2.85, _TOP_M, 220)
    room.place("lamp", devices.desk_lamp("paint_red"), 5.25, 2.2, _TOP_M, -30)
    room.place_jittered("books", furniture.books(), 5.2, 2.8, _TOP_M, 20)
    room.place_jittered("magazine", small.sheaf("magazine"), 4.05, 2.1, _TOP_M, 30)
    for i, x in enumerate((1.8, 4.6), 1):
        room.place(f"cable_{i}", devices.cable_run((x + 0.3, 2.45, 0.72), (x + 0.9, 2.45, 0.02), 0.15), 0, 0)
    room.place_at_wall(
        "cabinet", furniture.cupboard((1.1, 0.5, 0.72), "wide_drawers", "aluminium", 2, "white_plastic"), "north", 5.9
    )
    room.place("printer", devices.printer(), 6.05, 4.62, 0.755, -6)
    room.place("papers_2", small.sheaf("page", height_m=0.05), 5.55, 4.6, 0.755, 10)
    room.place_at_wall("shelf", tables.open_shelf(1.2, 1.8, "light_wood", rng, 5), "east", 2.4)
    room.place("plant_2", small.little_tree("stone_pot", "leaf"), 6.2, 0.5)
    room.place("plant_3", small.snake_plant("other_glaze", "striped_leaf"), 0.4, 4.5)
    room.place_at_wall("whiteboard", furniture.flat_picture("whiteboard", 1.8, 1.1, 0.02), "west", 2.4, 0.95)
    room.place_at_wall("window_1", furniture.flat_picture("window", 1.5, 1.4, 0.05), "south", 2.1, 0.9)
    room.place_at_wall("window_2", furniture.flat_picture("window", 1.5, 1.4, 0.05), "south", 4.2, 0.9)
    room.place_at_wall("poster", furniture.flat_picture("poster", 0.7, 1.0, 0.01), "north", 1.5, 1.0)
    room.place_at_wall("map", furniture.flat_picture("map", 1.2, 0.9, 0.01), "north", 3.2, 1.1)
    room.place_at_wall("clock", small.wall_clock("clock_face"), "north", 4.6, 2.0)
    room.place_at_wall("door", furniture.flat_picture("door", 0.9, 2.1), "east", 0.9)
    room.place("bin", small.bucket("rubber"), 3.2, 2.5)
    room.place("box", furniture.carton("carton", 0.5, 0.4, 0.35), 0.5, 0.45, 0, 12)
    room.place("basket", small.basket("dark_weave", "paper", 0.18, 0.32), 4.9, 4.6)
    room.place("jacket", [Part(draped(0.06, 0.4, 0.45, 0.006), "plaid")], 1.7, 3.62, 1.02)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: cool greys with one red, over carpet tiles."""
    colours = Palette(
        light_wood=(0.82, 0.70, 0.54),
        main=(0.24, 0.30, 0.38),
        second=(0.64, 0.66, 0.66),
        accent=(0.80, 0.22, 0.16),
        other=(0.10, 0.42, 0.50),
    )
    return common_painters(colours) | {
        "wall": lambda rng: textures.plaster(rng, (0.70, 0.73, 0.74)),
        "floor": lambda rng: fabric_textures.carpet(rng, (0.36, 0.40, 0.44), (0.62, 0.64, 0.6)),
    }
