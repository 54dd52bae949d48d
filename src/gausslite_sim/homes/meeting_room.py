"""Home 6, a meeting room: a long table with eight chairs, a projector, a slide on the wall, cables, coffee."""

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
        Lamp((1.7, 2.1, 2.65), 0.55, (1.0, 0.97, 0.90)),
        Lamp((3.9, 2.1, 2.65), 0.55, (1.0, 0.97, 0.90)),
        Lamp((2.8, 0.4, 1.8), 0.45, (0.88, 0.95, 1.06)),
    ),
    ambient=0.22,
    bounce=0.85,
)
_TOP_M = 0.75
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((0.6, 0.7, 1.55), (2.6, 2.1, 0.75)),
        ((1.7, 0.6, 1.50), (2.5, 2.2, 0.75)),
        ((3.2, 0.6, 1.50), (2.7, 2.2, 0.75)),
        ((4.9, 0.8, 1.55), (3.0, 2.1, 0.75)),
        ((5.1, 2.1, 1.50), (2.8, 2.1, 0.75)),
        ((4.9, 3.4, 1.50), (3.0, 2.1, 0.75)),
        ((3.6, 3.7, 1.50), (2.7, 2.0, 0.75)),
        ((2.0, 3.7, 1.50), (2.6, 2.0, 0.75)),
        ((0.6, 3.5, 1.50), (2.4, 2.2, 0.75)),
        ((0.55, 2.1, 1.50), (2.5, 2.1, 0.75)),
    ),
    (
        ((3.9, 3.6, 1.50), (0.2, 2.3, 1.2)),
        ((2.9, 3.5, 1.50), (0.2, 2.1, 1.2)),
        ((3.0, 0.7, 1.50), (0.2, 2.1, 1.2)),
        ((0.8, 0.6, 1.50), (5.0, 3.6, 0.9)),
        ((0.7, 3.4, 1.50), (5.3, 1.0, 0.8)),
        ((2.0, 0.7, 1.50), (5.4, 3.0, 1.0)),
    ),
    (
        ((2.3, 0.75, 1.15), (2.6, 2.1, 0.78)),
        ((2.9, 1.1, 2.0), (2.5, 2.1, 0.75)),
        ((1.6, 3.3, 1.15), (2.4, 2.1, 0.78)),
        ((3.2, 3.1, 2.0), (2.5, 2.1, 0.7)),
        ((4.7, 1.2, 1.05), (2.6, 2.2, 0.6)),
        ((5.0, 2.9, 2.0), (2.5, 2.1, 0.5)),
        ((3.6, 2.9, 1.15), (0.1, 2.1, 1.3)),
        ((3.3, 1.4, 2.0), (0.1, 2.1, 1.3)),
        ((2.2, 0.5, 1.9), (5.5, 3.4, 0.9)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 5.6 x 4.2 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(5.6, 4.2, 2.8, rng)
    room.place("table", tables.plain_table(3.0, 1.1, _TOP_M, "dark_wood", "steel"), 2.8, 2.1)
    shells = ("accent_glaze", "main_shell", "white_plastic", "main_shell")
    for i in range(4):
        x = 1.65 + 0.76 * i
        room.place_jittered(f"chair_{i + 1}", seating.shell_chair(shells[i]), x, 1.3, 0, 178 + 4 * i)
        room.place_jittered(f"chair_{i + 5}", seating.shell_chair(shells[(i + 1) % 4]), x, 2.9, 0, 3 * i)
    room.place_jittered("laptop", devices.laptop("slides"), 2.35, 1.85, _TOP_M, 172)
    room.place_jittered("mug_1", small.cup("mug_print"), 2.68, 1.82, _TOP_M, 70)
    room.place_jittered("mug_2", small.cup("mug_dots"), 3.3, 2.45, _TOP_M, 10)
    room.place("projector", devices.projector(), 2.9, 2.1, _TOP_M, -92)
    room.place_jittered("papers_1", small.sheaf("page"), 1.75, 1.85, _TOP_M, 190)
    room.place_jittered("papers_2", small.sheaf("page"), 2.5, 2.42, _TOP_M, 12)
    room.place_jittered("notebook", small.sheaf("other_cover", 0.16, 0.22, 0.02), 3.75, 1.8, _TOP_M, 160)
    room.place_jittered("bottle_1", small.bottle("bottle_label", "green_glass", 0.26), 3.1, 1.92, _TOP_M)
    room.place_jittered("bottle_2", small.bottle("bottle_label", "brown_glass", 0.26), 3.2, 1.86, _TOP_M, 50)
    room.place_jittered("jug", small.teapot("glaze"), 1.75, 2.28, _TOP_M, 40)
    room.place_jittered("phone", devices.phone("phone_screen"), 2.02, 2.4, _TOP_M, 20)
    room.place_jittered(
        "bowl", small.fruit_bowl("other_glaze", ("apple", "pear", "orange", "lemon")), 3.75, 2.35, _TOP_M
    )
    room.place_jittered("pen_cup", small.pen_cup("accent_glaze"), 2.3, 2.12, _TOP_M)
    room.place("cable", devices.cable_run((2.9, 2.5, 0.74), (3.0, 3.4, 0.01), 0.2), 0, 0)
    room.place_at_wall("screen", furniture.flat_picture("slides", 2.0, 1.3, 0.03), "west", 2.1, 0.9)
    room.place_at_wall("whiteboard", furniture.flat_picture("whiteboard", 1.6, 1.0, 0.02), "north", 2.4, 1.0)
    room.place_at_wall(
        "sideboard", furniture.cupboard((1.6, 0.42, 0.8), "doors", "light_wood", 2, "light_wood"), "east", 2.3
    )
    room.place("coffee_pot", furniture.kettle(), 5.38, 2.8, 0.835, 40)
    room.place("tray", small.plate("plate_print"), 5.38, 2.35, 0.835)
    room.place("mug_3", small.cup("mug_print"), 5.34, 2.3, 0.842, 90)
    room.place("box", furniture.carton("packet", 0.2, 0.12, 0.2), 5.4, 1.85, 0.835, -70)
    room.place("plant_1", small.little_tree("stone_pot", "leaf"), 5.1, 0.45)
    room.place("plant_2", small.snake_plant("accent_glaze", "striped_leaf"), 0.35, 3.85)
    room.place("plant_3", small.fern("other_glaze", "leaf", 1.2), 5.38, 1.65, 0.835)
    room.place_at_wall("window_1", furniture.flat_picture("window", 1.4, 1.3, 0.05), "south", 1.8, 0.95)
    room.place_at_wall("window_2", furniture.flat_picture("window", 1.4, 1.3, 0.05), "south", 3.7, 0.95)
    for i, x in enumerate((0.85, 2.75, 4.65), 1):
        room.place_at_wall(f"curtain_{i}", [Part(hanging(0.4, 2.3, 5), "main_cloth")], "south", x, 0.1, 0.1)
    room.place_at_wall("picture", furniture.flat_picture("painting_1", 0.8, 0.8), "east", 2.3, 1.3)
    room.place_at_wall("clock", small.wall_clock("clock_face"), "east", 1.2, 1.9)
    room.place_at_wall("door", furniture.flat_picture("door", 0.9, 2.1), "north", 4.7)
    room.place_at_wall("bin", small.bucket("steel"), "north", 3.8, 0, 0.25)
    room.place_jittered("backpack", small.basket("dark_weave", "leather", 0.15, 0.36), 0.6, 1.0)
    room.place("jacket", [Part(draped(0.05, 0.34, 0.4, 0.006), "plaid")], 3.17, 3.12, 0.82)
    room.place("rug", furniture.lying_sheet("other_rug", 3.6, 2.6, 0.008), 2.8, 2.1)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: walnut and mustard over a grey carpet."""
    colours = Palette(
        dark_wood=(0.42, 0.27, 0.18),
        main=(0.30, 0.34, 0.44),
        second=(0.72, 0.70, 0.66),
        accent=(0.82, 0.60, 0.14),
        other=(0.16, 0.34, 0.44),
    )
    return common_painters(colours) | {
        "wall": lambda rng: textures.plaster(rng, (0.80, 0.80, 0.76)),
        "floor": lambda rng: fabric_textures.carpet(rng, (0.44, 0.42, 0.40), (0.30, 0.30, 0.34)),
        "main_shell": lambda rng: textures.mottled(rng, colours.main, 0.2).with_gloss(0.12),
    }
