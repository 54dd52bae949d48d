"""More materials that repeat: knit, stripes, woven baskets, stone, brick, carpet. Seamless squares of seeded noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy import ndarray

from gausslite_sim.textures import SIDE_PX, Colour, Shade, Texture, grain, noise, tint

_Y, _X = np.mgrid[0:SIDE_PX, 0:SIDE_PX]


def knit(rng: np.random.Generator, colour: Colour, repeat_m: float = 0.25) -> Texture:
    """Columns of V-shaped stitches."""
    column = _X % 32
    slant = np.where(column < 16, _Y + 0.9 * column, _Y + 0.9 * (32 - column))
    stitch = 0.5 + 0.5 * np.sin(2 * np.pi * slant / 32)
    groove = 0.6 + 0.4 * np.abs(np.sin(np.pi * _X / 16))
    return Texture(tint((0.45 + 0.55 * stitch) * groove + 0.25 * (grain(rng) - 0.4), colour), repeat_m)


def stripes(rng: np.random.Generator, ground: Colour, lines: tuple[Colour, ...]) -> Texture:
    """Woven stripes of several widths."""
    rgb = np.broadcast_to(np.asarray(ground), (SIDE_PX, SIDE_PX, 3)).copy()
    for i in range(8):
        start, width = 64 * i + 8, (30, 12, 20, 6)[i % 4]
        rgb[:, start : start + width] = lines[i % len(lines)]
    return _woven(rng, rgb, 0.4)


def gingham(rng: np.random.Generator, colour: Colour) -> Texture:
    """White checks."""
    share = 0.5 * ((_X // 32) % 2 + (_Y // 32) % 2)[..., None]
    return _woven(rng, np.array([0.93, 0.92, 0.88]) * (1 - share) + share * np.asarray(colour), 0.2)


def zigzag(rng: np.random.Generator, ground: Colour, one: Colour, two: Colour) -> Texture:
    """Chevrons in two colours."""
    step = ((_Y + np.abs(_X % 128 - 64)) // 32) % 4
    return _woven(rng, np.array([ground, one, ground, two])[step], 0.42)


def berber(rng: np.random.Generator, ground: Colour, line: Colour) -> Texture:
    """A pale shaggy rug with a net of dark lozenges."""
    a, b = (_X + _Y) % 128, (_X - _Y) % 128
    wobble = 6 * noise(rng, 16, 16)
    on_line = (np.abs(a - 64 + wobble) < 7) | (np.abs(b - 64 - wobble) < 7)
    rgb = np.where(on_line[..., None], np.asarray(line), np.asarray(ground))
    tufts = 0.55 + 0.75 * noise(rng, 128, 128) - 0.25 * noise(rng, 512, 512)
    return Texture(np.clip(rgb * tufts[..., None] * 255, 0, 255).astype(np.uint8), 1.1)


def carpet(rng: np.random.Generator, colour: Colour, speck: Colour) -> Texture:
    """Office carpet tiles: specks, and every second tile turned."""
    ribs = np.where(((_X // 256) + (_Y // 256)) % 2 == 0, _X, _Y) % 8 < 4
    shade = 0.62 + 0.14 * ribs + 0.5 * (grain(rng) - 0.3)
    specks = (noise(rng, 256, 256) > 0.86)[..., None]
    return Texture(np.where(specks, tint(shade + 0.2, speck), tint(shade, colour)), 1.0)


def parquet(rng: np.random.Generator, colour: Colour, gloss: float = 0.05) -> Texture:
    """Herringbone of short boards, each of its own tone, with dark joints."""
    size, half = 128, 32
    shade = np.zeros((SIDE_PX, SIDE_PX))
    tones = rng.uniform(0.72, 1.1, (64, 64))
    # walk the stairs of a herringbone: rows of boards along x, columns of boards along y
    stair = (_X + _Y) // half % (2 * size // half)
    along_x = stair < size // half
    board = np.where(along_x, _Y // half * 7 + (_X - _Y % half + _Y) // size, _X // half * 5 + (_Y + _X) // size + 31)
    shade = tones[board % 64, (board // 64 + along_x * 3) % 64]
    streak = np.where(along_x, noise(rng, 128, 8), noise(rng, 8, 128))
    joint = np.where(along_x, _Y % half < 2, _X % half < 2)
    return Texture(tint((shade * (0.75 + 0.4 * streak)) * np.where(joint, 0.5, 1.0), colour), 1.2, gloss)


def brick(rng: np.random.Generator, colour: Colour) -> Texture:
    """Courses of bricks, each of its own tone, in pale mortar."""
    row = _Y // 64
    x = (_X + 64 * (row % 2)) % SIDE_PX
    tone = rng.uniform(0.65, 1.15, (8, 4))[row, x // 128][..., None]
    rough = 0.75 + 0.5 * grain(rng)[..., None]
    rgb = np.where(((_Y % 64 < 7) | (x % 128 < 7))[..., None], np.array([0.70, 0.67, 0.62]), np.asarray(colour) * tone)
    return Texture(np.clip(rgb * rough * 255, 0, 255).astype(np.uint8), 0.9)


def basket_weave(rng: np.random.Generator, colour: Colour) -> Texture:
    """Cane over and under."""
    over = ((_X // 32) + (_Y // 32)) % 2 == 0
    bulge = np.where(over, np.sin(np.pi * (_X % 32) / 32), np.sin(np.pi * (_Y % 32) / 32))
    strands = np.where(over, _Y % 8 < 2, _X % 8 < 2)
    return Texture(tint((0.35 + 0.75 * bulge) * np.where(strands, 0.6, 1.0) * (0.8 + 0.4 * grain(rng)), colour), 0.22)


def net(rng: np.random.Generator, colour: Colour) -> Texture:
    """The mesh of an office chair."""
    holes = (np.hypot(_X % 16 - 8, _Y % 16 - 8) < 4.5)[..., None]
    shade = 1.0 + 0.5 * (grain(rng) - 0.3)
    return Texture(np.where(holes, tint(0.35 * shade, colour), tint(1.2 * shade, colour)), 0.16)


def marble(rng: np.random.Generator) -> Texture:
    """White stone with grey veins, polished."""
    bend = noise(rng, 4, 4) + 0.5 * noise(rng, 16, 16) + 0.2 * noise(rng, 64, 64)
    veins = np.exp(-(((bend - 0.85) / 0.035) ** 2)) + 0.5 * np.exp(-(((bend - 0.6) / 0.02) ** 2))
    return Texture(tint(1.0 - 0.45 * np.clip(veins, 0, 1) + 0.06 * grain(rng), (0.88, 0.87, 0.85)), 0.9, 0.16)


def concrete(rng: np.random.Generator) -> Texture:
    """A grey floor with stains and hair cracks."""
    stains = 0.75 + 0.35 * noise(rng, 8, 8) + 0.3 * (grain(rng) - 0.4)
    crack = np.exp(-(((noise(rng, 8, 4) + 0.2 * noise(rng, 64, 64) - 0.6) / 0.006) ** 2))
    return Texture(tint(stains * (1 - 0.5 * crack), (0.56, 0.55, 0.53)), 2.2)


def striped_leaf(rng: np.random.Generator) -> Texture:
    """A stiff leaf with yellow margins and dark bands."""
    bands = 0.75 + 0.35 * np.sin(_Y / 12 + 6 * noise(rng, 16, 8))
    rgb = tint(bands * (0.8 + 0.3 * grain(rng)), (0.18, 0.36, 0.20))
    margin = np.abs(_X - SIDE_PX / 2) > 190
    return Texture(np.where(margin[..., None], tint(0.9 + 0.1 * bands, (0.74, 0.72, 0.36)), rgb))


def sneaker(rng: np.random.Generator, upper: Colour, trim: Colour) -> Texture:
    """The side of a shoe: seams, a stripe, a toe cap; u from one side over to the other, v from heel to toe."""
    picture = tint(0.7 + 0.4 * grain(rng), upper)
    pale = tuple(int(255 * c) for c in trim)
    for x in (110, 402):
        for shift in (0, 50, 100):
            cv2.line(picture, (x - 40, 170 + shift), (x + 40, 240 + shift), pale, 14, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 430), (SIDE_PX, SIDE_PX), pale, -1)
    for y in range(120, 330, 34):
        cv2.line(picture, (216, y), (296, y + 12), (240, 240, 236), 8, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (SIDE_PX, 60), tuple(int(150 * c) for c in upper), -1)
    return Texture(picture)


def _woven(rng: np.random.Generator, rgb: ndarray, repeat_m: float) -> Texture:
    thread: Shade = 0.8 + 0.12 * ((_X % 4 < 2) ^ (_Y % 4 < 2)) + 0.3 * (grain(rng) - 0.3)
    return Texture(np.clip(rgb * thread[..., None] * 255, 0, 255).astype(np.uint8), repeat_m)
