"""Home 7, a lounge: two sofas at a corner, a brick wall, a tea table, many plants, a record shelf, a window seat."""

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
from gausslite_sim.shapes import draped, hanging

LIGHTING = Lighting(
    (
        Lamp((2.4, 2.6, 2.5), 0.4, (1.0, 0.90, 0.72)),
        Lamp((4.9, 2.2, 1.7), 0.7, (1.02, 0.96, 0.86)),
        Lamp((0.55, 3.6, 1.8), 0.35, (1.0, 0.80, 0.55)),
    ),
    ambient=0.2,
    bounce=0.9,
)
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((3.6, 1.0, 1.50), (1.7, 2.6, 0.45)),
        ((3.9, 1.9, 1.45), (1.9, 2.6, 0.45)),
        ((3.7, 2.8, 1.50), (1.9, 2.6, 0.45)),
        ((3.3, 3.0, 1.50), (1.7, 2.4, 0.45)),
        ((2.9, 2.1, 1.50), (1.8, 2.7, 0.45)),
        ((2.6, 1.4, 1.50), (1.6, 2.7, 0.5)),
        ((2.2, 0.9, 1.50), (1.2, 3.4, 0.5)),
        ((2.0, 1.1, 1.50), (4.7, 3.4, 0.8)),
        ((2.8, 1.6, 1.50), (4.7, 3.6, 0.8)),
        ((3.3, 2.4, 1.50), (4.8, 1.2, 0.8)),
    ),
    (
        ((3.4, 2.3, 1.50), (3.0, 0.2, 0.9)),
        ((2.7, 2.0, 1.45), (1.2, 0.2, 1.0)),
        ((3.3, 1.4, 1.50), (0.3, 1.2, 0.9)),
        ((3.2, 1.2, 1.50), (1.9, 3.8, 0.8)),
        ((3.5, 1.8, 1.45), (2.2, 4.0, 0.6)),
        ((2.9, 1.7, 1.50), (4.9, 2.4, 0.8)),
    ),
    (
        ((3.0, 1.7, 1.05), (1.85, 2.55, 0.5)),
        ((2.4, 1.6, 1.95), (1.8, 2.6, 0.42)),
        ((3.3, 2.5, 1.9), (1.8, 2.6, 0.42)),
        ((2.7, 1.2, 1.1), (1.7, 3.6, 0.5)),
        ((3.2, 2.1, 1.95), (1.7, 3.6, 0.45)),
        ((3.4, 1.4, 1.9), (0.8, 2.4, 0.4)),
        ((3.2, 1.9, 1.05), (4.7, 3.6, 0.8)),
        ((2.9, 2.3, 1.95), (4.7, 3.6, 0.7)),
        ((2.3, 2.0, 1.1), (0.7, 2.5, 0.6)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 5.2 x 4.4 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(5.2, 4.4, 2.6, rng)
    room.place("rug", furniture.lying_sheet("rug", 2.6, 1.9, 0.01), 2.2, 2.5, 0, 4)
    room.place(
        "sofa_1", seating.couch(2.0, "main_cloth", ("zigzag", "accent_knit", "flowers", "stripes"), 3), 1.75, 3.88
    )
    room.place("sofa_2", seating.couch(1.3, "leather", ("plaid", "knit"), 2), 0.5, 2.3, 0, 90)
    room.place_jittered("tea_table", tables.plain_table(1.0, 0.6, 0.42, "marble", "brass", 0.02), 1.85, 2.6, 0, 0)
    room.place_jittered("teapot", small.teapot("other_glaze"), 1.72, 2.62, 0.42, 150)
    room.place_jittered("mug_1", small.cup("mug_print"), 2.02, 2.45, 0.42, 300)
    room.place_jittered("mug_2", small.cup("mug_dots"), 1.55, 2.45, 0.42, 30)
    room.place_jittered("magazine", small.sheaf("magazine"), 2.15, 2.72, 0.42, 20)
    room.place_jittered("book", small.sheaf("book_cover", 0.14, 0.2, 0.03), 1.92, 2.8, 0.42, -25)
    room.place_jittered("candles", small.candles(), 1.45, 2.72, 0.42)
    room.place_jittered("armchair", seating.armchair("second_cloth", "gingham"), 3.35, 3.45, 0, -20)
    room.place("lamp_1", devices.floor_lamp("shade_cloth"), 0.4, 3.9)
    room.place("lamp_2", devices.pendant("dark_weave", 0.6), 1.85, 2.6, 2.6)
    room.place("plant_1", small.little_tree("terracotta", "leaf"), 4.75, 3.85)
    room.place("plant_2", small.snake_plant("stone_pot", "striped_leaf"), 4.25, 4.05)
    room.place("plant_3", small.fern("accent_glaze", "leaf", 1.5), 4.55, 3.3)
    room.place("plant_4", small.fern("other_glaze", "leaf", 1.2), 2.2, 0.22, 1.07)
    room.place_at_wall("window", furniture.flat_picture("window", 1.9, 1.5, 0.05), "east", 2.1, 0.75)
    room.place_at_wall("bench", seating.bench(1.7, "light_wood", "stripes"), "east", 2.1, 0, 0.25)
    for i, y in enumerate((0.9, 3.3), 1):
        room.place_at_wall(f"curtain_{i}", [Part(hanging(0.45, 2.2, 5), "linen")], "east", y, 0.1, 0.1)
    room.place_at_wall("shelf", tables.open_shelf(1.3, 1.05, "dark_wood", rng, 3, 0.34), "south", 2.4)
    room.place("record_player", furniture.carton("dark_wood", 0.42, 0.32, 0.12), 2.75, 0.2, 1.07, 180)
    room.place("speaker_1", devices.speaker("light_wood"), 1.55, 0.2, 0, 180)
    room.place("speaker_2", devices.speaker("light_wood"), 3.25, 0.2, 0, 180)
    room.place("cable", devices.cable_run((2.75, 0.05, 0.95), (3.25, 0.1, 0.2), 0.3), 0, 0)
    room.place("clock", small.desk_clock("clock_face"), 2.45, 0.2, 1.07, 190)
    room.place_at_wall("poster_1", furniture.flat_picture("poster", 0.6, 0.85, 0.01), "south", 2.0, 1.4)
    room.place_at_wall("poster_2", furniture.flat_picture("painting_2", 0.7, 0.7), "south", 3.0, 1.4)
    room.place_at_wall("picture_1", furniture.flat_picture("landscape", 1.1, 0.8), "north", 1.75, 1.25)
    room.place_at_wall("picture_2", furniture.flat_picture("painting_3", 0.6, 0.6), "west", 2.3, 1.2)
    room.place_at_wall("door", furniture.flat_picture("door", 0.86, 2.05), "south", 0.7)
    room.place_jittered("basket", small.basket("weave", "accent_knit", 0.22, 0.28), 3.9, 0.5)
    room.place("crate", small.crate("worn_wood"), 4.5, 0.45, 0, -8)
    room.place("vase", small.round_vase("vase_print"), 4.5, 0.45, 0.015)
    room.place_jittered("ottoman", seating.ottoman("accent_knit"), 2.75, 1.75)
    room.place_jittered("shoe", small.shoes("sneaker"), 1.15, 1.05, 0, 200)
    room.place("guitar_case", furniture.carton("leather", 0.4, 0.14, 1.1), 0.25, 1.25, 0, 80)
    room.place("blanket", [Part(draped(0.34, 0.6, 0.2), "plaid")], 2.75, 1.75, 0.41, 30)
    room.place("phone", devices.phone("phone_screen"), 4.95, 1.6, 0.51, 40)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: brick, rust and teal over oak boards."""
    colours = Palette(
        main=(0.52, 0.26, 0.18), second=(0.78, 0.72, 0.60), accent=(0.86, 0.56, 0.20), other=(0.10, 0.36, 0.38)
    )
    return common_painters(colours) | {
        "wall": lambda rng: fabric_textures.brick(rng, (0.64, 0.36, 0.28)),
        "floor": lambda rng: textures.planks(rng, (0.72, 0.55, 0.38)).with_gloss(0.05),
    }
