"""Layout of the two-room home: kitchen (x 0 to 4.2 m) and living room (x 4.3 to 8.1 m) with a wide doorway."""

from __future__ import annotations

import numpy as np

from gausslite_sim import furniture, printed_textures, textures
from gausslite_sim.lighting import Lamp, Lighting
from gausslite_sim.mesh import Vector, box, merge_meshes
from gausslite_sim.scene_objects import Item, Part, place_parts
from gausslite_sim.textures import Texture

KITCHEN_END_M, LIVING_START_M, LENGTH_M = 4.2, 4.3, 8.1
WIDTH_M, HEIGHT_M = 4.5, 2.6
DOORWAY_M = (1.45, 3.05)
DOORWAY_HEIGHT_M = 2.15
TABLE_CENTRE_M = (2.0, 2.2)
TABLE_TOP_M = 0.74
LIGHTING = Lighting((Lamp((2.0, 2.0, 2.45), 1.0), Lamp((6.2, 2.3, 2.45), 1.0), Lamp((0.3, 2.2, 1.6), 0.35)))
"""A ceiling lamp in each room, and the window."""
_WORKTOP_M = 0.885


def paint_textures(seed: int) -> dict[str, Texture]:
    """Return every texture of the home by name."""
    rng = np.random.default_rng([seed, 1])
    return _materials(rng) | _pictures(rng)


def _materials(rng: np.random.Generator) -> dict[str, Texture]:
    """Return the repeating textures."""
    return {
        "oak": textures.wood(rng, (0.80, 0.58, 0.34)),
        "walnut": textures.wood(rng, (0.46, 0.30, 0.20), 0.6),
        "cherry": textures.wood(rng, (0.66, 0.34, 0.20), 0.5),
        "planks": textures.planks(rng, (0.74, 0.54, 0.36)),
        "tiles": textures.checker_tiles(rng, (0.86, 0.84, 0.78), (0.42, 0.44, 0.46)),
        "kitchen_wall": textures.wallpaper(rng, (0.90, 0.86, 0.70), (0.80, 0.56, 0.30)),
        "living_wall": textures.wallpaper(rng, (0.66, 0.76, 0.78), (0.30, 0.46, 0.50)),
        "ceiling": textures.plaster(rng, (0.92, 0.92, 0.90)),
        "plaid": textures.plaid(rng, (0.84, 0.80, 0.70), (0.70, 0.18, 0.16), (0.12, 0.20, 0.36)),
        "sofa_cloth": textures.cloth(rng, (0.30, 0.40, 0.56)),
        "seat_cloth": textures.cloth(rng, (0.72, 0.62, 0.46), 0.36),
        "shade_cloth": textures.cloth(rng, (0.96, 0.86, 0.64), 0.3),
        "worktop": textures.mottled(rng, (0.40, 0.40, 0.42), 0.7),
        "glaze": textures.mottled(rng, (0.94, 0.93, 0.90), 0.15),
        "paper": textures.brushed(rng, (0.90, 0.86, 0.76)),
        "steel": textures.brushed(rng, (0.72, 0.74, 0.78)),
        "rubber": textures.mottled(rng, (0.16, 0.16, 0.18), 0.4),
        "terracotta": textures.mottled(rng, (0.76, 0.42, 0.28), 0.5),
        "apple": textures.mottled(rng, (0.80, 0.20, 0.16), 0.6),
        "orange": textures.mottled(rng, (0.96, 0.58, 0.14), 0.4),
        "bark": textures.wood(rng, (0.44, 0.36, 0.22), 0.2),
    }


def _pictures(rng: np.random.Generator) -> dict[str, Texture]:
    """Return the textures fitted to one face."""
    return {
        "mug_print": printed_textures.mug_print(rng),
        "vase_print": printed_textures.vase_print(rng),
        "cover_red": printed_textures.book_cover(rng, (0.62, 0.16, 0.16)),
        "cover_blue": printed_textures.book_cover(rng, (0.14, 0.26, 0.50)),
        "cover_green": printed_textures.book_cover(rng, (0.14, 0.38, 0.24)),
        "book_row": printed_textures.book_row(rng),
        "screen": printed_textures.television(rng),
        "painting_1": printed_textures.painting(rng),
        "painting_2": printed_textures.painting(rng),
        "cushion": printed_textures.rug(rng, (0.16, 0.44, 0.42)),
        "newspaper": printed_textures.newspaper(rng),
        "carton": printed_textures.carton(rng, (0.72, 0.54, 0.34), "FRAGILE"),
        "cereal": printed_textures.carton(rng, (0.95, 0.74, 0.18), "CRUNCH"),
        "doors": printed_textures.panelled(rng, (0.84, 0.72, 0.52), 2, 1),
        "drawers": printed_textures.panelled(rng, (0.58, 0.38, 0.24), 2, 2),
        "door": printed_textures.panelled(rng, (0.88, 0.84, 0.76), 1, 2),
        "fridge": printed_textures.fridge_front(rng),
        "window": printed_textures.window_view(rng),
        "calendar": printed_textures.calendar(rng),
        "rug": printed_textures.rug(rng, (0.62, 0.16, 0.14)),
        "leaf": printed_textures.leaf_veins(rng),
    }


def furnish(seed: int) -> list[Item]:
    """Return every object in the world frame (z up); the seed jitters movable objects."""
    rng = np.random.default_rng([seed, 2])
    return [*_rooms(), *_dining(rng), *_kitchen(), *_living(rng)]


def _rooms() -> list[Item]:
    thick, far = 0.06, LENGTH_M
    low, high = DOORWAY_M
    middle = (KITCHEN_END_M + LIVING_START_M) / 2
    items = []
    for name, x0, x1, paper, floor, partition in (
        ("kitchen", 0.0, KITCHEN_END_M, "kitchen_wall", "tiles", (KITCHEN_END_M, middle)),
        ("living", LIVING_START_M, far, "living_wall", "planks", (middle, LIVING_START_M)),
    ):
        outer = (-thick, 0.0) if name == "kitchen" else (far, far + thick)
        left, right = min(x0, partition[0], outer[0]), max(x1, partition[1], outer[1])
        walls = [
            box((outer[0], 0, 0), (outer[1], WIDTH_M, HEIGHT_M)),
            box((left, -thick, 0), (right, 0, HEIGHT_M)),
            box((left, WIDTH_M, 0), (right, WIDTH_M + thick, HEIGHT_M)),
            box((partition[0], 0, 0), (partition[1], low, HEIGHT_M)),
            box((partition[0], high, 0), (partition[1], WIDTH_M, HEIGHT_M)),
            box((partition[0], low, DOORWAY_HEIGHT_M), (partition[1], high, HEIGHT_M)),
        ]
        items += [
            Item(f"{name}_walls", [Part(merge_meshes(walls), paper)], is_structure=True),
            Item(f"{name}_floor", [Part(box((left, 0, -thick), (right, WIDTH_M, 0)), floor)], is_structure=True),
            Item(
                f"{name}_ceiling",
                [Part(box((left, 0, HEIGHT_M), (right, WIDTH_M, HEIGHT_M + thick)), "ceiling")],
                is_structure=True,
            ),
        ]
    return items


def _dining(rng: np.random.Generator) -> list[Item]:
    """Return the table, the objects on it and the chairs round it."""
    x, y = TABLE_CENTRE_M

    def on_table(name: str, parts: list[Part], dx: float, dy: float, yaw_deg: float) -> Item:
        shift = rng.uniform(-0.03, 0.03, 2)
        position = (x + dx + shift[0], y + dy + shift[1], TABLE_TOP_M)
        return _item_at(name, parts, position, yaw_deg + rng.uniform(-15, 15))

    items = [_item_at("table", furniture.table(), (x, y, 0), 0)]
    for name, dx, dy, yaw_deg in (
        ("chair_1", -0.32, -0.62, 180),
        ("chair_2", 0.36, 0.64, 0),
        ("chair_3", 0.92, -0.1, -90),
    ):
        shift = rng.uniform(-0.03, 0.03, 2)
        turn = yaw_deg + rng.uniform(-10, 10)
        items.append(_item_at(name, furniture.chair(), (x + dx + shift[0], y + dy + shift[1], 0), turn))
    return [
        *items,
        on_table("mug", furniture.mug(), 0.34, -0.20, -60),
        on_table("vase", furniture.vase(), -0.22, 0.18, 0),
        on_table("books", furniture.books(), -0.42, -0.18, 10),
        on_table("bowl", furniture.bowl(), 0.12, 0.14, 0),
        on_table("newspaper", furniture.lying_sheet("newspaper", 0.3, 0.36, 0.004), 0.5, 0.18, 20),
    ]


def _kitchen() -> list[Item]:
    back = WIDTH_M
    return [
        _item_at("fridge", furniture.cupboard((0.62, 0.62, 1.75), "fridge", "steel"), (0.33, back, 0), 0),
        _item_at("counter", furniture.cupboard((2.4, 0.58, 0.85), "doors", "oak", 3, "worktop"), (1.9, back, 0), 0),
        _item_at("cupboard", furniture.cupboard((1.8, 0.34, 0.62), "doors", "oak", 2), (1.6, back, 1.5), 0),
        _item_at("kettle", furniture.kettle(), (1.2, back - 0.3, _WORKTOP_M), 30),
        _item_at("cereal", furniture.carton("cereal", 0.2, 0.07, 0.3), (1.75, back - 0.25, _WORKTOP_M), 12),
        _item_at("mug_2", furniture.mug(), (2.25, back - 0.36, _WORKTOP_M), 200),
        _item_at("window", furniture.flat_picture("window", 1.3, 1.1, 0.05), (0, 2.2, 1.0), 90),
        _item_at("door", furniture.flat_picture("door", 0.85, 2.05), (0.9, 0, 0), 180),
        _item_at("calendar", furniture.flat_picture("calendar", 0.42, 0.55, 0.008), (2.0, 0, 1.25), 180),
        _item_at("picture_1", furniture.flat_picture("painting_1", 0.7, 0.7), (3.1, 0, 1.2), 180),
    ]


def _living(rng: np.random.Generator) -> list[Item]:
    back = WIDTH_M
    return [
        _item_at("sofa", furniture.sofa(), (6.3, 0.46, 0), 180),
        _item_at("picture_2", furniture.flat_picture("painting_2", 0.9, 0.9), (6.3, 0, 1.15), 180),
        _item_at("rug", furniture.lying_sheet("rug", 2.0, 1.5, 0.008), (6.3, 2.0, 0), 0),
        _item_at("stool", furniture.stool(), (6.9 + rng.uniform(-0.05, 0.05), 1.6, 0.008), 20),
        _item_at("cabinet", furniture.cupboard((1.5, 0.42, 0.52), "drawers", "walnut", 2, "walnut"), (6.3, back, 0), 0),
        _item_at("tv", furniture.television(), (6.3, back - 0.2, 0.555), 0),
        _item_at("shelf", furniture.shelf(), (LENGTH_M, 2.2, 0), -90),
        _item_at("plant", furniture.plant(), (7.65, 4.05, 0), 0),
        _item_at("lamp", furniture.lamp(), (7.7, 0.42, 0), 0),
        _item_at("chair_4", furniture.chair(), (4.95, 3.75, 0), 35 + rng.uniform(-10, 10)),
        _item_at("box", furniture.carton("carton", 0.5, 0.4, 0.36), (4.75, 0.55, 0), 15),
    ]


def _item_at(name: str, parts: list[Part], position_m: Vector, yaw_deg: float) -> Item:
    return Item(name, place_parts(parts, position_m, yaw_deg))
