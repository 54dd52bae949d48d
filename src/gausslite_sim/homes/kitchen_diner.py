"""Home 3, a kitchen-diner: a full counter, a set table with country chairs, a pendant lamp, herbs."""

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
from gausslite_sim.shapes import draped, hanging

LIGHTING = Lighting(
    (
        Lamp((1.8, 3.4, 2.4), 0.55, (1.0, 0.95, 0.86)),
        Lamp((3.4, 1.5, 1.45), 0.35, (1.0, 0.88, 0.66)),
        Lamp((3.4, 0.5, 1.9), 0.5, (0.86, 0.94, 1.06)),
    ),
    ambient=0.24,
    bounce=0.8,
)
_COUNTERTOP_M = 0.935
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((1.3, 2.0, 1.50), (1.4, 4.0, 1.0)),
        ((1.9, 2.3, 1.45), (1.9, 4.1, 1.0)),
        ((2.6, 2.7, 1.50), (2.2, 4.1, 1.0)),
        ((3.4, 2.9, 1.50), (1.4, 4.0, 1.0)),
        ((3.9, 2.9, 1.50), (3.4, 1.4, 0.7)),
        ((4.6, 2.5, 1.45), (3.3, 1.4, 0.7)),
        ((4.95, 1.5, 1.50), (3.3, 1.4, 0.7)),
        ((4.5, 0.75, 1.50), (3.2, 1.5, 0.7)),
        ((3.4, 0.5, 1.55), (3.2, 1.8, 0.7)),
        ((2.1, 0.7, 1.50), (3.4, 1.5, 0.7)),
    ),
    (
        ((1.9, 1.5, 1.45), (3.6, 1.5, 0.6)),
        ((2.0, 2.4, 1.50), (3.5, 1.4, 0.7)),
        ((1.6, 2.2, 1.45), (0.4, 3.6, 0.9)),
        ((2.8, 2.6, 1.45), (3.0, 4.1, 1.1)),
        ((2.3, 2.5, 1.45), (1.2, 4.1, 1.1)),
        ((3.6, 2.8, 1.45), (5.0, 3.4, 0.9)),
    ),
    (
        ((1.6, 2.6, 1.15), (1.75, 4.1, 1.0)),
        ((2.4, 2.9, 1.95), (1.8, 4.1, 0.95)),
        ((1.2, 2.9, 1.85), (1.9, 4.1, 1.0)),
        ((2.2, 2.0, 1.9), (3.5, 1.4, 0.5)),
        ((2.4, 0.6, 1.05), (3.4, 1.5, 0.75)),
        ((3.0, 2.5, 2.0), (3.4, 1.5, 0.7)),
        ((4.7, 2.1, 1.1), (3.4, 1.4, 0.75)),
        ((4.6, 1.0, 1.95), (3.4, 1.5, 0.6)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 5.4 x 4.4 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(5.4, 4.4, 2.6, rng)
    room.place_at_wall("fridge", furniture.cupboard((0.66, 0.64, 1.8), "fridge_front", "white_plastic"), "north", 0.36)
    room.place_at_wall(
        "oven", furniture.cupboard((0.6, 0.6, 0.9), "oven_front", "steel", 1, "black_glass"), "north", 2.98
    )
    room.place_at_wall(
        "counter", furniture.cupboard((1.95, 0.6, 0.9), "doors", "light_wood", 3, "marble"), "north", 1.68
    )
    room.place_at_wall("cupboard", furniture.cupboard((1.2, 0.34, 0.6), "doors", "light_wood", 2), "north", 1.3, 1.55)
    room.place_at_wall("wall_shelf", tables.wall_board(0.9, "dark_wood"), "north", 2.5, 1.6)
    for i, (x, label) in enumerate(((2.2, "jar_label"), (2.36, "packet"), (2.5, "jar_label"), (2.66, "packet")), 1):
        room.place(f"jar_{i}", small.jar(label), x, 4.28, 1.6, 37 * i)
    room.place("herbs", small.fern("terracotta", "leaf", 0.8), 2.83, 4.28, 1.6)
    room.place_jittered("kettle", furniture.kettle(), 0.95, 4.15, _COUNTERTOP_M, 30)
    room.place_jittered("bottle_1", small.bottle("bottle_label", "green_glass"), 1.62, 4.05, _COUNTERTOP_M)
    room.place_jittered("bottle_2", small.bottle("jar_label", "brown_glass", 0.26), 1.78, 4.12, _COUNTERTOP_M, 60)
    room.place_jittered("cereal", furniture.carton("cereal", 0.2, 0.07, 0.29), 1.3, 4.2, _COUNTERTOP_M, 8)
    room.place_jittered("bread_box", furniture.carton("worn_wood", 0.34, 0.2, 0.18), 2.1, 4.2, _COUNTERTOP_M, -4)
    room.place_jittered("mug_1", small.cup("mug_print"), 1.98, 3.98, _COUNTERTOP_M, 200)
    room.place_jittered("toaster", furniture.carton("steel", 0.28, 0.16, 0.19), 2.45, 4.15, _COUNTERTOP_M, 5)
    room.place("pot", small.pot("paint_red"), 2.85, 4.08, _COUNTERTOP_M, 20)
    room.place("pan", small.plate("black_glass"), 3.1, 4.22, _COUNTERTOP_M)
    room.place_jittered("table", tables.plain_table(1.5, 0.9, 0.75, "light_wood", "dark_wood"), 3.4, 1.5)
    for i, (x, y, yaw) in enumerate(((3.0, 0.85, 180), (3.8, 0.88, 170), (3.05, 2.2, -5), (3.85, 2.15, 12)), 1):
        room.place_jittered(
            f"chair_{i}", seating.spindle_chair("green_paint" if i % 2 else "worn_wood", "gingham"), x, y, 0, yaw
        )
    room.place_jittered(
        "bowl",
        small.fruit_bowl("other_glaze", ("apple", "orange", "lemon", "pear", "apple", "orange")),
        3.42,
        1.5,
        0.75,
    )
    room.place_jittered("teapot", small.teapot("accent_glaze"), 3.85, 1.62, 0.75, 130)
    for i, (x, y) in enumerate(((3.0, 1.25), (3.05, 1.78), (3.8, 1.25)), 1):
        room.place_jittered(f"plate_{i}", small.plate("plate_print"), x, y, 0.75)
    room.place_jittered("mug_2", small.cup("mug_dots"), 3.3, 1.22, 0.75, 80)
    room.place_jittered("newspaper", furniture.lying_sheet("newspaper", 0.29, 0.36, 0.004), 3.95, 1.3, 0.75, 75)
    room.place("lamp", devices.pendant("accent_glaze", 0.75), 3.4, 1.5, 2.6)
    room.place("rug", furniture.lying_sheet("rug", 2.4, 1.8, 0.008), 3.4, 1.5)
    room.place_at_wall("window", furniture.flat_picture("window", 1.6, 1.2, 0.05), "south", 3.5, 0.95)
    room.place_at_wall("curtain", [Part(hanging(0.5, 1.5, 5), "gingham")], "south", 4.55, 0.8, 0.1)
    room.place_at_wall("shelf", tables.open_shelf(0.9, 1.7, "dark_wood", rng, 4), "east", 1.0)
    room.place_at_wall(
        "sideboard", furniture.cupboard((1.2, 0.4, 0.8), "drawers", "dark_wood", 2, "dark_wood"), "east", 3.2
    )
    room.place("plant", small.snake_plant("other_glaze", "striped_leaf"), 5.15, 2.9, 0.835)
    room.place("basket", small.basket("weave", "apple", 0.16, 0.16), 5.15, 3.5, 0.835)
    room.place_at_wall("picture", furniture.flat_picture("painting_2", 0.6, 0.6), "east", 3.2, 1.4)
    room.place_at_wall("calendar", furniture.flat_picture("calendar", 0.4, 0.55, 0.008), "west", 2.6, 1.25)
    room.place_at_wall("clock", small.wall_clock("clock_face"), "north", 3.9, 1.9)
    room.place_at_wall("door", furniture.flat_picture("door", 0.86, 2.05), "west", 1.3)
    room.place("crate", small.crate("worn_wood"), 4.1, 4.1, 0, 10)
    room.place("bottle_3", small.bottle("bottle_label", "green_glass", 0.31), 4.0, 4.1, 0.015, 30)
    room.place("bottle_4", small.bottle("bottle_label", "brown_glass", 0.31), 4.2, 4.12, 0.015, 80)
    room.place("stool", seating.bar_stool("leather"), 0.45, 3.3)
    room.place("towel", [Part(draped(0.03, 0.3, 0.35, 0.004), "stripes")], 2.95, 3.77, 0.83, 90)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: blue, cream and red over checkered tiles in white and brown."""
    colours = Palette(
        main=(0.26, 0.34, 0.52), second=(0.88, 0.84, 0.74), accent=(0.74, 0.22, 0.18), other=(0.22, 0.40, 0.52)
    )
    return common_painters(colours) | {
        "wall": lambda rng: textures.plaster(rng, (0.90, 0.84, 0.68)),
        "floor": lambda rng: textures.checker_tiles(rng, (0.84, 0.80, 0.74), (0.52, 0.36, 0.30)),
    }
