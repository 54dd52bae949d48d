"""Home 4, a study: a desk with two screens before a wall of books, a reading chair, a globe of light, cables."""

from __future__ import annotations

import numpy as np

from gausslite_sim import device_objects as devices
from gausslite_sim import furniture, textures
from gausslite_sim import seating_objects as seating
from gausslite_sim import small_objects as small
from gausslite_sim import table_objects as tables
from gausslite_sim.lighting import Lamp, Lighting
from gausslite_sim.materials import Painter, Palette, common_painters
from gausslite_sim.room import Room
from gausslite_sim.scene_objects import Item, Part
from gausslite_sim.shapes import hanging

LIGHTING = Lighting(
    (
        Lamp((2.0, 2.0, 2.4), 0.6, (1.0, 0.90, 0.74)),
        Lamp((0.4, 2.0, 1.7), 0.6, (0.84, 0.94, 1.08)),
        Lamp((3.6, 0.6, 1.7), 0.3, (1.0, 0.82, 0.58)),
    ),
    ambient=0.2,
    bounce=0.85,
)
_TOP_M = 0.73
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((2.6, 1.2, 1.50), (1.5, 3.4, 0.8)),
        ((2.9, 1.7, 1.45), (1.7, 3.5, 0.85)),
        ((2.8, 2.3, 1.50), (1.5, 3.5, 0.85)),
        ((2.3, 1.7, 1.45), (1.6, 3.5, 0.85)),
        ((1.2, 1.7, 1.50), (1.7, 3.5, 0.85)),
        ((0.7, 2.1, 1.50), (1.8, 3.4, 0.85)),
        ((1.0, 1.4, 1.50), (3.6, 2.2, 1.0)),
        ((1.2, 2.0, 1.50), (3.9, 2.4, 1.1)),
        ((1.9, 2.2, 1.50), (3.9, 1.4, 1.0)),
        ((2.4, 2.4, 1.50), (3.5, 0.6, 0.7)),
    ),
    (
        ((2.5, 2.5, 1.45), (3.2, 0.5, 0.7)),
        ((2.0, 2.2, 1.50), (1.0, 0.3, 0.9)),
        ((2.9, 2.4, 1.45), (0.3, 1.0, 0.8)),
        ((2.8, 1.8, 1.45), (0.6, 3.3, 0.9)),
        ((2.1, 1.4, 1.50), (3.9, 2.9, 1.0)),
        ((1.9, 1.8, 1.45), (3.9, 2.0, 1.3)),
    ),
    (
        ((2.2, 2.6, 1.15), (1.55, 3.5, 0.8)),
        ((1.7, 2.3, 1.95), (1.6, 3.5, 0.75)),
        ((1.0, 2.6, 1.15), (1.7, 3.5, 0.8)),
        ((2.4, 2.0, 1.95), (1.6, 3.5, 0.6)),
        ((2.6, 2.6, 1.9), (3.9, 2.0, 1.3)),
        ((2.4, 1.5, 1.1), (3.9, 2.1, 1.3)),
        ((2.6, 1.9, 1.95), (3.5, 0.7, 0.5)),
        ((1.6, 1.2, 1.1), (1.6, 3.5, 0.75)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 4.1 x 4.0 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(4.1, 4.0, 2.5, rng)
    room.place("desk", tables.desk(1.8, "dark_wood", "black_plastic", "drawers"), 1.6, 3.55, 0, 0)
    room.place_jittered("monitor_1", devices.monitor("code", 0.62), 1.3, 3.72, _TOP_M, -8)
    room.place_jittered("monitor_2", devices.monitor("slides", 0.55), 1.98, 3.7, _TOP_M, 12)
    room.place_jittered("keyboard", devices.keyboard(), 1.45, 3.38, _TOP_M, 2)
    room.place_jittered("mouse", devices.mouse(), 1.78, 3.38, _TOP_M, -10)
    room.place_jittered("headphones", devices.headphones(), 2.1, 3.4, _TOP_M, 35)
    room.place_jittered("mug", small.cup("mug_dots"), 1.06, 3.42, _TOP_M, 120)
    room.place("lamp_1", devices.desk_lamp("blue_paint"), 0.86, 3.72, _TOP_M, 35)
    room.place_jittered("papers", small.sheaf("page"), 2.33, 3.58, _TOP_M, 18)
    room.place_jittered("pen_cup", small.pen_cup("other_glaze"), 2.36, 3.8, _TOP_M)
    room.place_jittered("phone", devices.phone("phone_screen"), 1.9, 3.28, _TOP_M, 20)
    room.place("cable", devices.cable_run((1.3, 3.88, 0.72), (0.5, 3.95, 0.3), 0.22), 0, 0)
    room.place_jittered("office_chair", seating.office_chair("net"), 1.55, 2.75, 0, 175)
    room.place_at_wall("shelf_1", tables.open_shelf(1.2, 2.1, "light_wood", rng, 6), "east", 2.0)
    room.place_at_wall("shelf_2", tables.open_shelf(0.9, 2.1, "light_wood", rng, 6), "east", 3.15)
    room.place("plant_1", small.fern("accent_glaze", "leaf", 1.0), 3.95, 2.35, 1.07)
    room.place("vase", small.round_vase("vase_print"), 3.95, 1.6, 1.77)
    room.place("clock_1", small.desk_clock("clock_face"), 3.92, 2.35, 1.42, -80)
    room.place("box_1", furniture.carton("packet", 0.22, 0.16, 0.14), 3.94, 3.35, 1.42, -85)
    room.place("speaker", devices.speaker("dark_wood"), 3.93, 3.4, 0.72, -90)
    room.place("armchair", seating.armchair("accent_knit", "plaid"), 3.4, 0.65, 0, 135)
    room.place("lamp_2", devices.floor_lamp("shade_cloth"), 3.75, 1.15)
    room.place_jittered("side_table", tables.round_table(0.24, 0.5, "light_wood", "black_plastic"), 2.65, 0.5)
    room.place_jittered("books", furniture.books(), 2.65, 0.5, 0.5, 20)
    room.place("rug", furniture.lying_sheet("other_rug", 2.0, 1.5, 0.01), 2.1, 1.5, 0, 8)
    room.place_at_wall("window", furniture.flat_picture("window", 1.3, 1.3, 0.05), "west", 1.9, 0.9)
    room.place_at_wall("curtain", [Part(hanging(0.5, 2.1, 6), "main_cloth")], "west", 2.85, 0.15, 0.12)
    room.place_at_wall(
        "cabinet", furniture.cupboard((1.0, 0.4, 0.72), "wide_drawers", "dark_wood", 1, "dark_wood"), "south", 0.95
    )
    room.place("printer", devices.printer(), 0.85, 0.22, 0.755, 180)
    room.place("fan", devices.fan(), 1.3, 0.22, 0.755, 165)
    room.place_at_wall("map", furniture.flat_picture("map", 1.1, 0.8, 0.012), "south", 0.95, 1.35)
    room.place_at_wall("picture", furniture.flat_picture("painting_3", 0.6, 0.6), "north", 3.0, 1.4)
    room.place_at_wall("pinboard", furniture.flat_picture("photo", 0.34, 0.42), "north", 0.5, 1.4)
    room.place_at_wall("poster", furniture.flat_picture("poster", 0.6, 0.85, 0.01), "south", 2.3, 1.1)
    room.place_at_wall("door", furniture.flat_picture("door", 0.84, 2.03), "west", 0.6)
    room.place("bin", small.basket("dark_weave", "paper", 0.16, 0.3), 0.45, 3.2)
    room.place_jittered("shoe", small.shoes("boot", "rubber"), 0.4, 2.6, 0, 100)
    room.place("plant_2", small.little_tree("stone_pot", "leaf"), 0.35, 1.25)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: deep green and brass over dark planks."""
    colours = Palette(
        light_wood=(0.60, 0.40, 0.24),
        dark_wood=(0.30, 0.18, 0.12),
        main=(0.16, 0.28, 0.24),
        second=(0.66, 0.58, 0.44),
        accent=(0.70, 0.46, 0.16),
        other=(0.36, 0.14, 0.16),
    )
    return common_painters(colours) | {
        "wall": lambda rng: textures.wallpaper(rng, (0.40, 0.50, 0.44), (0.52, 0.60, 0.46)),
        "floor": lambda rng: textures.planks(rng, (0.50, 0.34, 0.22)).with_gloss(0.06),
    }
