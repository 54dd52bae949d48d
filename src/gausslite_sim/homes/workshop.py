"""Home 8, a workshop: a bench under a wall of tools, a rack of tins, a ladder, a wheel in repair, crates and cables."""

from __future__ import annotations

import numpy as np

from gausslite_sim import device_objects as devices
from gausslite_sim import fabric_textures, furniture
from gausslite_sim import seating_objects as seating
from gausslite_sim import small_objects as small
from gausslite_sim import table_objects as tables
from gausslite_sim import workshop_objects as tools
from gausslite_sim.lighting import Lamp, Lighting
from gausslite_sim.materials import Painter, Palette, common_painters
from gausslite_sim.room import Room
from gausslite_sim.scene_objects import Item

LIGHTING = Lighting(
    (
        Lamp((1.6, 3.2, 2.6), 0.6, (0.94, 0.98, 1.02)),
        Lamp((3.9, 1.6, 2.6), 0.45, (1.0, 0.94, 0.82)),
        Lamp((0.4, 1.2, 1.9), 0.4, (0.9, 0.96, 1.05)),
    ),
    ambient=0.2,
    bounce=0.75,
)
_TOP_M = 0.9
# per trajectory: waypoints (camera position, look-at target) in metres; the last trajectory is held out
TRAJECTORIES = (
    (
        ((0.8, 1.6, 1.55), (1.7, 3.7, 0.95)),
        ((1.7, 1.9, 1.50), (1.7, 3.7, 0.95)),
        ((2.6, 2.2, 1.50), (1.6, 3.6, 0.95)),
        ((2.9, 2.9, 1.55), (1.7, 3.5, 0.95)),
        ((2.6, 1.8, 1.50), (4.8, 2.8, 0.9)),
        ((2.9, 2.4, 1.50), (4.9, 3.0, 0.9)),
        ((3.3, 2.9, 1.50), (4.8, 2.2, 0.9)),
        ((3.5, 1.9, 1.50), (4.5, 0.5, 0.9)),
        ((2.8, 1.5, 1.50), (4.6, 0.5, 0.9)),
        ((2.2, 1.9, 1.50), (2.9, 0.2, 0.8)),
    ),
    (
        ((3.3, 1.7, 1.50), (1.0, 0.4, 0.7)),
        ((2.6, 2.2, 1.50), (0.3, 1.6, 0.9)),
        ((3.4, 2.2, 1.45), (1.7, 3.6, 0.9)),
        ((3.6, 2.9, 1.50), (4.0, 4.0, 0.8)),
        ((2.4, 1.4, 1.50), (4.9, 2.3, 1.0)),
        ((1.9, 2.1, 1.50), (4.7, 0.6, 0.8)),
    ),
    (
        ((1.2, 2.3, 1.2), (1.75, 3.6, 0.98)),
        ((2.0, 2.2, 2.0), (1.7, 3.6, 0.92)),
        ((2.5, 2.7, 1.25), (1.6, 3.6, 0.95)),
        ((3.2, 2.1, 1.05), (4.9, 2.8, 0.9)),
        ((3.0, 3.2, 2.0), (4.9, 2.6, 0.8)),
        ((3.5, 2.4, 1.95), (4.9, 2.8, 0.8)),
        ((3.2, 2.2, 1.05), (4.5, 0.5, 0.9)),
        ((3.9, 2.5, 2.0), (4.5, 0.5, 0.8)),
        ((2.4, 1.1, 1.9), (4.6, 0.5, 0.9)),
    ),
)


def furnish(rng: np.random.Generator) -> list[Item]:
    """Return all objects of the room, 5.2 x 4.2 m. Their positions are x, y, z in metres, then yaw in degrees."""
    room = Room(5.2, 4.2, 2.8, rng)
    room.place_at_wall("workbench", tables.workbench(2.4), "north", 1.7, 0, 0.38)
    room.place_at_wall("pegboard", furniture.flat_picture("pegboard", 2.2, 0.9, 0.02), "north", 1.7, 1.15)
    room.place_at_wall("saw", tools.saw(), "north", 1.1, 1.8, 0.025)
    room.place_at_wall("spanners", tools.spanners(6), "north", 1.75, 1.75, 0.025)
    room.place_at_wall("wall_shelf", tables.wall_board(1.0, "worn_wood"), "north", 2.3, 1.55)
    for i in range(4):
        label = "jar_label" if i % 2 else "packet"
        room.place(f"jar_{i + 1}", small.jar(label), 1.95 + 0.2 * i, 4.09, 1.55, 50 * i)
    room.place_jittered("drill", tools.drill("yellow_paint"), 1.75, 3.68, _TOP_M, 60)
    room.place_jittered("hammer", tools.hammer(), 2.1, 3.75, _TOP_M, 50)
    room.place_jittered("toolbox", tools.toolbox("paint_red"), 1.25, 3.9, _TOP_M, 5)
    room.place_jittered("plans", small.sheaf("map", 0.42, 0.3, 0.002), 1.55, 3.55, _TOP_M, 8)
    room.place("lamp", devices.desk_lamp("green_paint"), 2.6, 3.98, _TOP_M, -20)
    room.place_jittered("mug", small.cup("mug_print"), 2.35, 3.72, _TOP_M, 100)
    room.place_jittered("radio", furniture.carton("printer_front", 0.3, 0.12, 0.18), 2.25, 4.0, _TOP_M, -6)
    room.place("cable", devices.cable_run((2.6, 3.95, 0.9), (3.1, 4.1, 0.3), 0.35), 0, 0)
    room.place_jittered("stool", seating.bar_stool("worn_wood"), 1.3, 2.85)
    room.place_at_wall("rack", tables.metal_rack(1.4, 1.9, 5), "east", 2.75, 0, 0.24)
    for i, (y, z, texture) in enumerate(
        (
            (2.35, 0.59, "paint_label"),
            (2.62, 0.59, "packet"),
            (2.9, 0.59, "paint_label"),
            (2.5, 1.03, "packet"),
            (2.8, 1.03, "paint_label"),
        ),
        1,
    ):
        room.place(f"paint_can_{i}", small.paint_can(texture), 4.92, y, z, 77 * i)
    room.place("box_1", furniture.carton("carton", 0.36, 0.3, 0.28), 4.92, 3.2, 0.59, -85)
    room.place("box_2", furniture.carton("packet", 0.3, 0.28, 0.22), 4.92, 3.15, 1.03, -95)
    room.place("box_3", furniture.carton("carton", 0.4, 0.32, 0.26), 4.92, 2.5, 1.47, -88)
    room.place("helmet", tools.helmet("yellow_paint"), 4.92, 3.05, 1.47, 30)
    room.place("crate_1", small.crate("worn_wood"), 4.92, 2.45, 0.16, 90)
    room.place("bottle", small.bottle("bottle_label", "brown_glass"), 4.92, 3.25, 0.16)
    room.place_at_wall("ladder", tools.ladder(), "south", 4.5, 0, 0.55)
    room.place_at_wall("wheel", tools.wheel(), "south", 3.5, 0, 0.35)
    room.place_at_wall("broom", tools.broom(), "south", 2.9, 0, 0.4)
    room.place("bucket", small.bucket("blue_paint"), 3.9, 0.45)
    room.place_jittered("boots", small.shoes("boot", "rubber"), 2.45, 0.5, 0, 190)
    room.place("trestle", tables.plain_table(1.1, 0.55, 0.8, "light_wood", "worn_wood", 0.08), 1.0, 0.75)
    room.place_jittered("fan", devices.fan(), 0.75, 0.7, 0.8, 160)
    room.place_jittered("basket", small.basket("dark_weave", "straw", 0.18, 0.2), 1.2, 0.75, 0.8)
    room.place("crate_2", small.crate("light_wood"), 0.4, 1.9, 0, 92)
    room.place("rope", small.basket("straw", "straw", 0.2, 0.12), 0.4, 1.9, 0.02)
    room.place_at_wall("window", furniture.flat_picture("window", 1.1, 0.9, 0.05), "west", 1.3, 1.25)
    room.place_at_wall("poster", furniture.flat_picture("poster", 0.6, 0.85, 0.01), "west", 2.5, 1.1)
    room.place_at_wall("calendar", furniture.flat_picture("calendar", 0.4, 0.55, 0.008), "south", 1.7, 1.2)
    room.place_at_wall("clock", small.wall_clock("clock_face"), "east", 1.5, 2.0)
    room.place_at_wall("door", furniture.flat_picture("door", 0.9, 2.05), "east", 1.2)
    room.place_at_wall("cabinet", furniture.cupboard((0.8, 0.45, 1.5), "drawers", "blue_paint", 1), "north", 3.9)
    room.place("plant", small.snake_plant("terracotta", "striped_leaf"), 3.9, 3.95, 1.5)
    room.place_jittered("dustpan", furniture.carton("green_paint", 0.24, 0.2, 0.05), 2.65, 0.75, 0, 20)
    return room.items


def painters() -> dict[str, Painter]:
    """Return the textures' painters: bricks and primary colours over concrete."""
    colours = Palette(
        accent=(0.80, 0.30, 0.12), other=(0.16, 0.36, 0.56), main=(0.30, 0.34, 0.36), second=(0.66, 0.62, 0.54)
    )
    return common_painters(colours) | {
        "wall": lambda rng: fabric_textures.brick(rng, (0.78, 0.74, 0.68)),
        "floor": fabric_textures.concrete,
    }
