"""Home 2, a bedroom: a made bed between two nightstands, a wardrobe, a dressing table, shoes on a shaggy rug."""

from __future__ import annotations

import numpy as np

from gausslite_sim import device_objects as devices
from gausslite_sim import fabric_textures, furniture, textures
from gausslite_sim import seating_objects as seating
from gausslite_sim import small_objects as small
from gausslite_sim.lighting import Lamp, Lighting
from gausslite_sim.materials import Painter, Palette, common_painters
from gausslite_sim.room import Room
from gausslite_sim.scene_objects import Item, Part
from gausslite_sim.shapes import draped, hanging

LIGHTING = Lighting(
    (
        Lamp((2.3, 2.2, 2.35), 0.5, (1.0, 0.92, 0.78)),
        Lamp((4.3, 2.9, 1.6), 0.65, (0.88, 0.95, 1.05)),
        Lamp((0.35, 3.1, 1.3), 0.22, (1.0, 0.82, 0.56)),
    ),
    ambient=0.24,
    bounce=0.8,
)
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((3.3, 1.0, 1.50), (1.0, 3.3, 0.5)),
        ((3.6, 1.7, 1.45), (0.9, 3.2, 0.6)),
        ((3.3, 2.5, 1.50), (1.0, 3.3, 0.6)),
        ((3.4, 3.0, 1.50), (2.3, 3.9, 0.5)),
        ((2.9, 3.5, 1.45), (2.2, 3.9, 0.5)),
        ((3.1, 3.4, 1.50), (0.9, 3.4, 0.6)),
        ((3.4, 2.6, 1.50), (2.4, 0.3, 0.8)),
        ((2.6, 1.9, 1.50), (4.4, 1.6, 0.6)),
        ((2.3, 0.95, 1.45), (2.0, 2.0, 0.4)),
        ((1.4, 0.9, 1.50), (0.8, 2.9, 0.6)),
        ((0.6, 0.85, 1.50), (0.4, 3.3, 0.6)),
    ),
    (
        ((1.2, 0.9, 1.50), (4.4, 3.4, 0.9)),
        ((2.4, 0.9, 1.45), (4.4, 1.6, 0.9)),
        ((3.0, 1.3, 1.45), (2.3, 2.9, 0.2)),
        ((3.0, 2.0, 1.45), (2.4, 3.1, 0.2)),
        ((3.4, 2.9, 1.45), (3.6, 0.2, 1.0)),
        ((3.2, 3.3, 1.45), (2.2, 1.5, 0.2)),
    ),
    (
        ((2.9, 3.0, 1.15), (2.3, 3.92, 0.52)),
        ((2.45, 2.75, 1.95), (2.3, 3.92, 0.5)),
        ((3.2, 3.35, 1.85), (2.3, 3.9, 0.5)),
        ((3.1, 1.3, 1.0), (2.4, 2.5, 0.1)),
        ((3.0, 2.2, 1.95), (2.35, 2.5, 0.05)),
        ((2.9, 3.0, 1.05), (2.4, 2.5, 0.1)),
        ((2.7, 2.3, 1.95), (4.4, 1.6, 0.6)),
        ((2.5, 1.5, 1.10), (4.4, 1.5, 0.7)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 4.6 x 4.2 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(4.6, 4.2, 2.5, rng)
    pillows = ("linen", "linen", "flowers", "accent_knit")
    room.place("bed", seating.bed(1.5, "light_wood", "stripes", pillows, "knit"), 1.25, 3.1)
    for i, x in enumerate((0.25, 2.3), 1):
        room.place_at_wall(
            f"nightstand_{i}",
            furniture.cupboard((0.42, 0.38, 0.46), "drawers", "light_wood", 1, "light_wood"),
            "north",
            x,
        )
    room.place("lamp", devices.desk_lamp("accent_glaze"), 0.18, 4.02, 0.495, -30)
    room.place_jittered("alarm_clock", small.desk_clock("clock_face"), 0.34, 3.9, 0.495, 8)
    room.place_jittered("glasses_case", furniture.carton("leather", 0.16, 0.06, 0.04), 0.25, 3.82, 0.495, 30)
    room.place_jittered("books", furniture.books(), 2.26, 3.97, 0.495, 20)
    room.place_jittered("mug", small.cup("mug_dots"), 2.42, 3.88, 0.495, 140)
    room.place_jittered("phone", devices.phone("phone_screen"), 2.28, 3.82, 0.495, 70)
    room.place("rug", furniture.lying_sheet("other_rug", 1.5, 2.0, 0.012), 2.9, 2.4)
    room.place_jittered("shoe_1", small.shoes("sneaker"), 2.3, 2.55, 0.012, 65)
    room.place_jittered("shoe_2", small.shoes("boot", "rubber"), 4.2, 0.5, 0, 30)
    room.place_at_wall("wardrobe", furniture.cupboard((1.5, 0.6, 2.05), "doors", "light_wood", 2), "south", 2.3)
    room.place("box_1", furniture.carton("carton", 0.5, 0.4, 0.28), 2.0, 0.32, 2.05, 5)
    room.place("suitcase", furniture.carton("leather", 0.7, 0.45, 0.24), 2.65, 0.33, 2.05, -4)
    room.place_at_wall(
        "dresser", furniture.cupboard((1.1, 0.42, 0.8), "drawers", "dark_wood", 2, "dark_wood"), "east", 1.55
    )
    room.place_at_wall("mirror", furniture.flat_picture("black_glass", 0.6, 0.8, 0.03), "east", 1.55, 1.0)
    room.place("vase", small.round_vase("vase_print"), 4.38, 1.2, 0.835)
    room.place("jewel_box", furniture.carton("weave", 0.2, 0.14, 0.1), 4.38, 1.6, 0.835, -80)
    room.place("bottle_1", small.bottle("bottle_label", "green_glass", 0.2), 4.35, 1.85, 0.835)
    room.place("bottle_2", small.bottle("jar_label", "brown_glass", 0.15), 4.4, 1.95, 0.835, 40)
    room.place_jittered("stool", furniture.stool(), 3.75, 1.55)
    room.place_jittered("basket", small.basket("dark_weave", "stripes", 0.24, 0.34), 4.25, 2.45)
    room.place_at_wall("window", furniture.flat_picture("window", 1.2, 1.2, 0.05), "east", 3.2, 0.95)
    for i, y in enumerate((2.55, 3.85), 1):
        room.place_at_wall(f"curtain_{i}", [Part(hanging(0.45, 2.2, 5), "main_cloth")], "east", y, 0.1, 0.12)
    room.place("plant", small.fern("terracotta", "leaf", 1.6), 4.05, 3.7)
    room.place_at_wall("picture_1", furniture.flat_picture("landscape", 1.0, 0.7), "north", 1.25, 1.3)
    room.place_at_wall("picture_2", furniture.flat_picture("photo", 0.26, 0.32), "west", 2.9, 1.45)
    room.place_at_wall("picture_3", furniture.flat_picture("photo", 0.26, 0.32), "west", 2.5, 1.5)
    room.place_at_wall("door", furniture.flat_picture("door", 0.86, 2.03), "south", 0.75)
    room.place_at_wall("poster", furniture.flat_picture("poster", 0.5, 0.7, 0.01), "south", 3.75, 1.2)
    room.place("blanket", [Part(draped(0.4, 0.4, 0.1), "plaid")], 3.75, 1.55, 0.47, 20)
    room.place_at_wall("laundry", small.basket("weave", "second_cloth", 0.2, 0.45), "west", 1.2, 0, 0.3)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: soft greens and rose over a carpet."""
    colours = Palette(
        light_wood=(0.84, 0.74, 0.58),
        main=(0.46, 0.54, 0.44),
        second=(0.86, 0.78, 0.70),
        accent=(0.72, 0.40, 0.40),
        other=(0.34, 0.44, 0.58),
    )
    return common_painters(colours) | {
        "wall": lambda rng: textures.wallpaper(rng, (0.80, 0.83, 0.78), (0.60, 0.68, 0.60)),
        "floor": lambda rng: fabric_textures.carpet(rng, (0.70, 0.64, 0.55), (0.5, 0.44, 0.36)),
    }
