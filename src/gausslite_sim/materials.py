"""Texture painters by material name: a home provides the palette, and only used textures are painted."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gausslite_sim import fabric_textures, label_textures, printed_textures, screen_textures, textures
from gausslite_sim.textures import Colour, Texture

Painter = Callable[[np.random.Generator], Texture]


@dataclass(frozen=True, slots=True)
class Palette:
    """A home's colours, RGB in [0, 1]: two woods, four colours of cloths, prints and glazes, and a pale glaze."""

    light_wood: Colour = (0.78, 0.60, 0.40)
    dark_wood: Colour = (0.36, 0.24, 0.17)
    main: Colour = (0.35, 0.42, 0.50)
    second: Colour = (0.74, 0.68, 0.58)
    accent: Colour = (0.76, 0.36, 0.22)
    other: Colour = (0.20, 0.40, 0.40)
    glaze: Colour = (0.90, 0.88, 0.82)


def paint(painters: dict[str, Painter], used: Iterable[str], seed: int) -> dict[str, Texture]:
    """Return the textures with these names; each has its own seed and does not depend on the others."""
    names = sorted(set(used))
    return {name: painters[name](np.random.default_rng([seed, zlib.crc32(name.encode())])) for name in names}


def common_painters(colours: Palette) -> dict[str, Painter]:
    """Return the painters that every home shares."""
    return _solids(colours) | _cloths(colours) | _pictures(colours)


def _solids(colours: Palette) -> dict[str, Painter]:
    def mottled(colour: Colour, strength: float, gloss: float = 0.0) -> Painter:
        return lambda rng: textures.mottled(rng, colour, strength).with_gloss(gloss)

    def brushed(colour: Colour, gloss: float) -> Painter:
        return lambda rng: textures.brushed(rng, colour).with_gloss(gloss)

    return {
        "walnut": lambda rng: textures.wood(rng, colours.dark_wood, 0.6),
        "cherry": lambda rng: textures.wood(rng, (0.62, 0.33, 0.20), 0.5),
        "light_wood": lambda rng: textures.wood(rng, colours.light_wood, 0.7).with_gloss(0.06),
        "dark_wood": lambda rng: textures.wood(rng, colours.dark_wood, 0.6).with_gloss(0.1),
        "worn_wood": lambda rng: textures.wood(rng, (0.62, 0.47, 0.30), 1.1),
        "bark": lambda rng: textures.wood(rng, (0.40, 0.32, 0.22), 0.2),
        "ceiling": lambda rng: textures.plaster(rng, (0.92, 0.91, 0.88)),
        "trim": lambda rng: textures.plaster(rng, (0.90, 0.89, 0.86)),
        "steel": brushed((0.66, 0.68, 0.71), 0.35),
        "aluminium": brushed((0.74, 0.75, 0.77), 0.18),
        "brass": brushed((0.78, 0.62, 0.30), 0.35),
        "paper": brushed((0.90, 0.87, 0.79), 0.0),
        "cover": mottled((0.34, 0.30, 0.28), 0.5),
        "black_plastic": mottled((0.085, 0.085, 0.095), 0.4, 0.1),
        "black_glass": mottled((0.05, 0.05, 0.06), 0.2, 0.5),
        "white_plastic": mottled((0.86, 0.86, 0.84), 0.12, 0.1),
        "rubber": mottled((0.12, 0.12, 0.13), 0.5),
        "leather": mottled((0.26, 0.17, 0.12), 0.7, 0.12),
        "wax": mottled((0.93, 0.88, 0.76), 0.15),
        "glow": mottled((1.0, 0.97, 0.88), 0.05),
        "straw": mottled((0.72, 0.60, 0.36), 0.6),
        "terracotta": mottled((0.72, 0.42, 0.30), 0.5),
        "stone_pot": mottled((0.46, 0.47, 0.48), 0.7),
        "glaze": mottled(colours.glaze, 0.2, 0.22),
        "accent_glaze": mottled(colours.accent, 0.35, 0.25),
        "other_glaze": mottled(colours.other, 0.35, 0.25),
        "green_glass": mottled((0.10, 0.26, 0.14), 0.3, 0.4),
        "brown_glass": mottled((0.26, 0.13, 0.05), 0.3, 0.4),
        "paint_red": mottled((0.72, 0.14, 0.12), 0.3, 0.15),
        "blue_paint": mottled((0.14, 0.32, 0.58), 0.4, 0.15),
        "yellow_paint": mottled((0.92, 0.72, 0.12), 0.3, 0.15),
        "green_paint": mottled((0.20, 0.44, 0.30), 0.4, 0.1),
        "apple": mottled((0.74, 0.16, 0.13), 0.6, 0.1),
        "orange": mottled((0.95, 0.56, 0.12), 0.4),
        "lemon": mottled((0.93, 0.84, 0.22), 0.35),
        "pear": mottled((0.62, 0.68, 0.24), 0.5),
        "marble": fabric_textures.marble,
        "leaf": printed_textures.leaf_veins,
        "striped_leaf": fabric_textures.striped_leaf,
    }


def _cloths(colours: Palette) -> dict[str, Painter]:
    main, second, accent, other = colours.main, colours.second, colours.accent, colours.other
    return {
        "main_cloth": lambda rng: textures.cloth(rng, main, 0.3),
        "second_cloth": lambda rng: textures.cloth(rng, second, 0.24),
        "linen": lambda rng: textures.cloth(rng, (0.90, 0.88, 0.83), 0.2),
        "seat_cloth": lambda rng: textures.cloth(rng, accent, 0.36),
        "shade_cloth": lambda rng: textures.cloth(rng, (0.97, 0.88, 0.68), 0.3),
        "net": lambda rng: fabric_textures.net(rng, (0.16, 0.17, 0.19)),
        "plaid": lambda rng: textures.plaid(rng, second, accent, main),
        "stripes": lambda rng: fabric_textures.stripes(rng, (0.90, 0.87, 0.80), (other, accent, main)),
        "knit": lambda rng: fabric_textures.knit(rng, second, 0.25),
        "accent_knit": lambda rng: fabric_textures.knit(rng, accent, 0.25),
        "gingham": lambda rng: fabric_textures.gingham(rng, accent),
        "zigzag": lambda rng: fabric_textures.zigzag(rng, (0.92, 0.88, 0.78), other, accent),
        "flowers": lambda rng: textures.wallpaper(rng, second, accent),
        "weave": lambda rng: fabric_textures.basket_weave(rng, (0.70, 0.52, 0.30)),
        "dark_weave": lambda rng: fabric_textures.basket_weave(rng, (0.40, 0.27, 0.16)),
        "rug": lambda rng: printed_textures.rug(rng, accent),
        "other_rug": lambda rng: fabric_textures.berber(rng, (0.86, 0.82, 0.74), main),
        "sneaker": lambda rng: fabric_textures.sneaker(rng, other, (0.92, 0.92, 0.9)),
        "boot": lambda rng: fabric_textures.sneaker(rng, (0.40, 0.25, 0.14), (0.85, 0.7, 0.3)),
    }


def _pictures(colours: Palette) -> dict[str, Painter]:
    dark, accent, other = colours.dark_wood, colours.accent, colours.other
    return {
        **{
            f"spine_{i}": partial(label_textures.spine, colour=c)
            for i, c in enumerate((accent, other, (0.82, 0.78, 0.66), (0.16, 0.18, 0.26)), 1)
        },
        **{f"painting_{i}": printed_textures.painting for i in (1, 2, 3)},
        "landscape": label_textures.landscape,
        "poster": partial(label_textures.poster, colour=other),
        "photo": label_textures.photograph,
        "map": label_textures.city_map,
        "mug_print": printed_textures.mug_print,
        "mug_dots": partial(label_textures.dotted_mug, colour=other),
        "vase_print": printed_textures.vase_print,
        "plate_print": partial(label_textures.plate, colour=other),
        "bottle_label": partial(label_textures.bottle_label, colour=accent),
        "jar_label": partial(label_textures.jar_label, colour=other),
        "packet": partial(label_textures.packet, colour=accent),
        "paint_label": partial(label_textures.packet, colour=other),
        "cereal": lambda rng: printed_textures.carton(rng, (0.93, 0.72, 0.18), "CRUNCH"),
        "carton": lambda rng: printed_textures.carton(rng, (0.70, 0.53, 0.34), "FRAGILE"),
        "magazine": partial(label_textures.magazine, colour=accent),
        "screen": lambda rng: printed_textures.television(rng).with_gloss(0.15),
        "cover_red": lambda rng: printed_textures.book_cover(rng, accent),
        "cover_blue": lambda rng: printed_textures.book_cover(rng, other),
        "cover_green": lambda rng: printed_textures.book_cover(rng, (0.16, 0.36, 0.24)),
        "book_cover": lambda rng: printed_textures.book_cover(rng, accent),
        "other_cover": lambda rng: printed_textures.book_cover(rng, other),
        "page": label_textures.page,
        "newspaper": printed_textures.newspaper,
        "keys": screen_textures.keys,
        "code": screen_textures.code_screen,
        "slides": screen_textures.slide_screen,
        "phone_screen": screen_textures.phone_screen,
        "printer_front": screen_textures.printer_front,
        "clock_face": screen_textures.clock_face,
        "whiteboard": screen_textures.whiteboard,
        "calendar": printed_textures.calendar,
        "window": printed_textures.window_view,
        "drawers": lambda rng: printed_textures.panelled(rng, colours.light_wood, 1, 3),
        "wide_drawers": lambda rng: printed_textures.panelled(rng, dark, 2, 2),
        "doors": lambda rng: printed_textures.panelled(rng, colours.light_wood, 2, 1),
        "door": lambda rng: printed_textures.panelled(rng, (0.86, 0.83, 0.76), 1, 2),
        "fridge_front": lambda rng: printed_textures.fridge_front(rng).with_gloss(0.1),
        "oven_front": screen_textures.oven_front,
        "pegboard": label_textures.pegboard,
    }
