"""Repeating textures: wood, tiles, cloth, plaster. Each is a seamless square painted from seeded noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

SIDE_PX = 512

Colour = tuple[float, float, float]
Shade = Float64[ndarray, "s s"]


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A square image. repeat_m: period in metres; None for a texture fitted to one face.

    gloss: share of specularly reflected light, 0 for matt.
    """

    rgb: UInt8[ndarray, "s s 3"]
    repeat_m: float | None = None
    gloss: float = 0.0

    def with_gloss(self, gloss: float) -> Texture:
        """Return the texture with this gloss."""
        return Texture(self.rgb, self.repeat_m, gloss)


def noise(rng: np.random.Generator, rows: int, columns: int) -> Shade:
    """Return smooth seamless noise in [0, 1] with this many cells (powers of two up to SIDE_PX)."""
    margin = 2
    lattice = np.pad(rng.random((rows, columns)).astype(np.float32), margin, mode="wrap")
    high, wide = SIDE_PX // rows, SIDE_PX // columns
    size = ((columns + 2 * margin) * wide, (rows + 2 * margin) * high)
    smooth = cv2.resize(lattice, size, interpolation=cv2.INTER_CUBIC)
    inner = smooth[margin * high : margin * high + SIDE_PX, margin * wide : margin * wide + SIDE_PX]
    return np.asarray(np.clip(inner, 0.0, 1.0), np.float64)


def grain(rng: np.random.Generator) -> Shade:
    """Return noise in [0, 1] with detail down to single texels."""
    layers = ((8, 0.2), (32, 0.25), (128, 0.3), (512, 0.25))
    return np.asarray(sum(weight * noise(rng, cells, cells) for cells, weight in layers))


def tint(shade: Shade, colour: Colour) -> UInt8[ndarray, "s s 3"]:
    """Return a colour (components 0 to 1) multiplied by the shade."""
    bright: Float64[ndarray, "s s 3"] = np.multiply.outer(shade * 255.0, np.asarray(colour))
    bright += 0.5
    np.minimum(bright, 255.0, out=bright)
    return bright.astype(np.uint8)


def wood(rng: np.random.Generator, colour: Colour, repeat_m: float = 0.9) -> Texture:
    """Boards seen along the grain, which runs to the right."""
    return Texture(tint(_wood_shade(rng), colour), repeat_m)


def planks(rng: np.random.Generator, colour: Colour) -> Texture:
    """A floor of eight rows of planks, each of its own tone, with dark joints."""
    shade, row_px = _wood_shade(rng), SIDE_PX // 8
    for row in range(8):
        rows = slice(row * row_px, (row + 1) * row_px)
        joint = int(rng.integers(0, SIDE_PX))
        tone = np.where((np.arange(SIDE_PX) - joint) % SIDE_PX < SIDE_PX // 2, *rng.uniform(0.72, 1.12, 2))
        shade[rows] *= tone
        shade[row * row_px : row * row_px + 2] *= 0.45
        for x in (joint, joint + SIDE_PX // 2):
            shade[rows, x % SIDE_PX] *= 0.45
    return Texture(tint(shade, colour), 1.28)


def checker_tiles(rng: np.random.Generator, light: Colour, dark: Colour) -> Texture:
    """Four by four stone tiles in two colours with grout."""
    cell = SIDE_PX // 4
    row, column = np.divmod(np.arange(SIDE_PX), cell)[0], np.divmod(np.arange(SIDE_PX), cell)[0]
    even = (row[:, None] + column[None, :]) % 2 == 0
    veins = 1.0 - 0.5 * np.exp(-(((noise(rng, 8, 8) + 0.25 * noise(rng, 32, 32) - 0.6) / 0.02) ** 2))
    shade = (0.72 + 0.5 * grain(rng)) * veins
    rgb = np.where(even[..., None], tint(shade, light), tint(shade, dark))
    edge = np.arange(SIDE_PX) % cell < 4
    rgb[edge[:, None] | edge[None, :]] = (120, 112, 104)
    return Texture(rgb, 1.2)


def plaster(rng: np.random.Generator, colour: Colour) -> Texture:
    """Rough paint."""
    return Texture(tint(0.8 + 0.4 * grain(rng), colour), 1.0)


def wallpaper(rng: np.random.Generator, ground: Colour, motif: Colour) -> Texture:
    """Offset rows of a leaf motif on fine stripes."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX]
    shade = 0.88 + 0.16 * grain(rng) + 0.05 * np.sin(2 * np.pi * x / 16)
    rgb = tint(shade, ground)
    mask = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    pitch = 128
    for row in range(-1, 5):
        for column in range(-1, 5):
            centre = (column * pitch + (row % 2) * pitch // 2 + pitch // 2, row * pitch + pitch // 2)
            for turn in (-50, 0, 50):
                across, down = (round(26 * f(np.radians(turn))) for f in (np.sin, np.cos))
                tip = (centre[0] + across, centre[1] - down)
                cv2.ellipse(mask, tip, (9, 26), turn, 0, 360, color=255, thickness=-1, lineType=cv2.LINE_AA)
            cv2.line(mask, centre, (centre[0], centre[1] + 34), 255, 4, cv2.LINE_AA)
    alpha = (mask / 255.0)[..., None]
    veins = tint(shade * (0.9 + 0.2 * (y % 6 < 2)), motif)
    return Texture((alpha * veins + (1 - alpha) * rgb).astype(np.uint8), 0.8)


def cloth(rng: np.random.Generator, colour: Colour, repeat_m: float = 0.5) -> Texture:
    """A coarse weave: threads over and under, in herringbone bands."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX]
    slant = np.where((x // 64) % 2 == 0, x + y, x - y)
    weave = 0.5 + 0.5 * np.sin(2 * np.pi * slant / 16)
    shade = 0.55 + 0.3 * weave + 0.4 * (grain(rng) - 0.2)
    return Texture(tint(shade, colour), repeat_m)


def plaid(rng: np.random.Generator, ground: Colour, stripe: Colour, line: Colour) -> Texture:
    """Crossing stripes of two colours on a woven ground."""
    position = np.arange(SIDE_PX) % 128
    wide, thin = ((position > 20) & (position < 64)).astype(float), ((position > 92) & (position < 100)).astype(float)
    twill = 0.9 + 0.1 * np.sin(2 * np.pi * np.add.outer(np.arange(SIDE_PX), np.arange(SIDE_PX)) / 8)
    share_wide, share_thin = (0.5 * (band[:, None] + band[None, :])[..., None] for band in (wide, thin))
    mixed = np.asarray(ground) * (1 - share_wide) + np.asarray(stripe) * share_wide
    mixed = mixed * (1 - share_thin) + np.asarray(line) * share_thin
    shade = (twill * (0.8 + 0.4 * grain(rng)))[..., None]
    return Texture(np.clip(mixed * shade * 255, 0, 255).astype(np.uint8), 0.36)


def brushed(rng: np.random.Generator, colour: Colour) -> Texture:
    """Metal or glazed clay with fine scratches along u."""
    return Texture(tint(0.78 + 0.22 * noise(rng, 512, 8) + 0.14 * noise(rng, 16, 16), colour), 0.4)


def mottled(rng: np.random.Generator, colour: Colour, strength: float = 0.3) -> Texture:
    """Clay, ceramic, fruit: spots of many sizes."""
    return Texture(tint(1.0 - 0.5 * strength + strength * grain(rng) * 1.2, colour), 0.3)


def _wood_shade(rng: np.random.Generator) -> Shade:
    y = np.arange(SIDE_PX)[:, None] / SIDE_PX
    bend = 1.3 * noise(rng, 4, 2) + 0.25 * noise(rng, 16, 4)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (9 * y + 2.2 * bend))
    streaks = noise(rng, 256, 8)
    pores = noise(rng, 512, 32) < 0.12
    return np.asarray((0.62 + 0.26 * rings**1.5 + 0.3 * streaks) * np.where(pores, 0.72, 1.0))
