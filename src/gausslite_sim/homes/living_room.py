"""Home 1, a living room: sofa and armchair round a coffee table, books, plants, a television."""

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
        Lamp((2.6, 2.2, 2.5), 0.55, (1.0, 0.93, 0.80)),
        Lamp((0.5, 2.3, 1.7), 0.55, (0.86, 0.94, 1.05)),
        Lamp((4.75, 0.5, 1.75), 0.4, (1.0, 0.85, 0.62)),
    ),
    ambient=0.22,
    bounce=0.8,
)
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((2.2, 3.1, 1.50), (2.6, 1.2, 0.45)),
        ((1.2, 2.7, 1.45), (2.5, 1.4, 0.45)),
        ((1.0, 1.7, 1.50), (2.6, 1.3, 0.45)),
        ((1.3, 2.5, 1.55), (3.9, 2.7, 0.6)),
        ((2.4, 2.9, 1.50), (4.2, 2.2, 0.7)),
        ((3.6, 3.0, 1.55), (2.6, 1.3, 0.45)),
        ((3.9, 2.0, 1.55), (2.4, 1.3, 0.45)),
        ((3.6, 1.9, 1.50), (1.2, 0.9, 0.6)),
        ((3.3, 2.2, 1.50), (1.3, 3.9, 0.9)),
        ((2.6, 2.4, 1.50), (3.1, 4.1, 0.9)),
    ),
    (
        ((4.0, 1.6, 1.50), (5.1, 3.2, 1.0)),
        ((3.7, 2.4, 1.45), (4.6, 0.6, 0.9)),
        ((2.7, 2.6, 1.50), (2.6, 0.4, 0.6)),
        ((1.7, 2.5, 1.45), (0.3, 1.2, 0.8)),
        ((1.9, 1.9, 1.50), (0.6, 3.5, 0.8)),
        ((2.8, 2.1, 1.45), (4.6, 2.7, 0.6)),
    ),
    (
        ((1.8, 2.4, 1.10), (2.7, 1.35, 0.45)),
        ((2.6, 2.35, 1.95), (2.6, 1.3, 0.42)),
        ((3.4, 2.4, 1.05), (2.5, 1.3, 0.45)),
        ((3.1, 2.9, 1.90), (2.5, 0.6, 0.45)),
        ((1.6, 3.2, 1.10), (2.6, 0.7, 0.45)),
        ((2.3, 2.0, 1.95), (4.3, 2.8, 0.4)),
        ((3.1, 1.9, 1.05), (4.4, 2.9, 0.5)),
        ((2.9, 3.4, 1.85), (4.2, 2.6, 0.4)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 5.2 x 4.3 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(5.2, 4.3, 2.6, rng)
    room.place("rug", furniture.lying_sheet("rug", 2.4, 1.7, 0.01), 2.6, 1.5)
    room.place("sofa", seating.couch(1.9, "main_cloth", ("accent_knit", "zigzag", "flowers"), 3), 2.6, 0.5, 0, 180)
    room.place("blanket", [Part(draped(0.5, 0.7, 0.25), "plaid")], 3.36, 0.62, 0.56, 0)
    room.place_jittered("coffee_table", tables.round_table(0.45, 0.4, "light_wood", "dark_wood"), 2.6, 1.5)
    room.place_jittered("mug_1", small.cup("mug_print"), 2.78, 1.68, 0.4, 40)
    room.place_jittered("magazine", small.sheaf("magazine"), 2.45, 1.62, 0.4, 25)
    room.place_jittered("candles", small.candles(), 2.48, 1.34, 0.4)
    room.place_jittered("remote", small.sheaf("keys", 0.05, 0.17, 0.018), 2.8, 1.38, 0.4, -30)
    room.place_jittered("armchair", seating.armchair("second_cloth", "stripes"), 4.3, 2.75, 0, -65)
    room.place_jittered("ottoman", seating.ottoman("knit"), 1.05, 2.15)
    room.place_at_wall(
        "cabinet", furniture.cupboard((1.7, 0.42, 0.5), "wide_drawers", "dark_wood", 2, "dark_wood"), "north", 2.8
    )
    room.place_at_wall("television", furniture.television(), "north", 2.8, 0.535, 0.22)
    room.place_at_wall("speaker_1", devices.speaker("dark_wood"), "north", 2.12, 0.535, 0.22)
    room.place_at_wall("speaker_2", devices.speaker("dark_wood"), "north", 3.48, 0.535, 0.22)
    room.place_at_wall("shelf", tables.open_shelf(1.1, 1.9, "light_wood", rng, 5), "east", 1.4)
    room.place("vase", small.round_vase("vase_print"), 4.45, 4.02, 0.0)
    room.place("stool", furniture.stool(), 4.75, 3.85)
    room.place("basket", small.basket("weave", "knit"), 0.5, 0.5)
    room.place("lamp", devices.floor_lamp("shade_cloth"), 4.75, 0.45)
    room.place("plant_1", small.little_tree("terracotta", "leaf"), 0.45, 3.85)
    room.place("plant_2", small.snake_plant("stone_pot", "striped_leaf"), 1.35, 4.0)
    room.place("fern", small.fern("accent_glaze", "leaf", 1.3), 4.75, 3.85, 0.455)
    room.place_at_wall("window", furniture.flat_picture("window", 1.5, 1.3, 0.05), "west", 2.2, 0.85)
    for i, y in enumerate((1.2, 3.2), 1):
        room.place_at_wall(f"curtain_{i}", [Part(hanging(0.5, 2.1, 5), "second_cloth")], "west", y, 0.15, 0.12)
    room.place_at_wall("picture_1", furniture.flat_picture("painting_1", 0.8, 0.8), "south", 2.1, 1.2)
    room.place_at_wall("picture_2", furniture.flat_picture("landscape", 0.9, 0.6), "south", 3.15, 1.3)
    room.place_at_wall("picture_3", furniture.flat_picture("photo", 0.3, 0.36), "east", 2.7, 1.4)
    room.place_at_wall("clock", small.wall_clock("clock_face"), "east", 3.3, 1.7)
    room.place_at_wall("door", furniture.flat_picture("door", 0.86, 2.05), "north", 0.85)
    room.place_jittered("shoe", small.shoes("sneaker"), 0.95, 3.55, 0, 160)
    room.place_jittered("books", furniture.books(), 1.05, 2.15, 0.4, 15)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: warm colours over herringbone parquet."""
    colours = Palette(
        main=(0.24, 0.36, 0.40), second=(0.80, 0.70, 0.54), accent=(0.78, 0.34, 0.18), other=(0.12, 0.36, 0.40)
    )
    return common_painters(colours) | {
        "wall": lambda rng: textures.wallpaper(rng, (0.87, 0.84, 0.74), (0.66, 0.62, 0.46)),
        "floor": lambda rng: fabric_textures.parquet(rng, (0.70, 0.50, 0.32)),
    }
