"""Textures fitted to one face: covers, labels, screens, doors; painted once with seeded random colours."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite_sim.textures import SIDE_PX, Colour, Texture, grain, noise, tint, wood

Picture = UInt8[ndarray, "s s 3"]
Ink = tuple[int, int, int]
FONT = cv2.FONT_HERSHEY_DUPLEX
_WORDS = ("ATLAS", "SOUP", "RIVER", "GARDEN", "NORTH", "CLAY", "STARS", "BREAD", "HARBOUR", "MOSS", "TIDE", "ORCHARD")


def mug_print(rng: np.random.Generator) -> Texture:
    """White glaze with bands, dots and text repeated twice."""
    picture = tint(0.9 + 0.14 * grain(rng), (0.93, 0.92, 0.88))
    cv2.rectangle(picture, (0, 60), (SIDE_PX, 130), (196, 40, 44), -1)
    cv2.rectangle(picture, (0, 400), (SIDE_PX, 452), (28, 78, 150), -1)
    for i in range(16):
        cv2.circle(picture, (16 + 32 * i, 95), 11, (250, 236, 120), -1, cv2.LINE_AA)
        cv2.circle(picture, (32 * i, 426), 8, (240, 240, 240), -1, cv2.LINE_AA)
    for x in (30, 286):
        write(picture, "CAFE", (x, 300), 2.6, (30, 60, 40), (FONT, 9))
    return Texture(picture)


def vase_print(rng: np.random.Generator) -> Texture:
    """Blue bands, waves and petals on white."""
    picture = tint(0.9 + 0.12 * grain(rng), (0.9, 0.93, 0.96))
    blue = (34, 62, 140)
    for y in (40, 210, 380, 470):
        cv2.rectangle(picture, (0, y), (SIDE_PX, y + 14), blue, -1)
    for i in range(12):
        x = round((i + 0.5) * SIDE_PX / 12)
        for turn in range(0, 360, 60):
            tip = (x + round(17 * np.cos(np.radians(turn))), 132 + round(26 * np.sin(np.radians(turn))))
            cv2.ellipse(picture, tip, (6, 18), turn + 90, 0, 360, color=blue, thickness=-1, lineType=cv2.LINE_AA)
        cv2.ellipse(picture, (x, 300), (20, 50), 0, 180, 360, color=(60, 110, 190), thickness=8, lineType=cv2.LINE_AA)
    return Texture(picture)


def book_cover(rng: np.random.Generator, colour: Colour) -> Texture:
    """A framed title and an emblem on cloth."""
    picture = tint(0.78 + 0.4 * grain(rng), colour)
    gold = (232, 200, 110)
    cv2.rectangle(picture, (36, 36), (SIDE_PX - 36, SIDE_PX - 36), gold, 6)
    write(picture, str(rng.choice(_WORDS)), (70, 150), 2.2, gold, (FONT, 6))
    cv2.circle(picture, (256, 320), 84, gold, 8, cv2.LINE_AA)
    for i in range(8):
        angle = i * np.pi / 4
        end = (256 + round(78 * np.cos(angle)), 320 + round(78 * np.sin(angle)))
        cv2.line(picture, (256, 320), end, gold, 5, cv2.LINE_AA)
    return Texture(picture)


def book_row(rng: np.random.Generator) -> Texture:
    """The backs of many books side by side."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), 26, np.uint8)
    x = 2
    while x < SIDE_PX - 14:
        width, top = int(rng.integers(22, 46)), int(rng.integers(8, 130))
        right = min(x + width, SIDE_PX - 2)
        back: Ink = ink_of(rng.integers(30, 215, 3))
        cv2.rectangle(picture, (x, top), (right, SIDE_PX), back, -1)
        light = ink_of(np.minimum(np.array(back) + 90, 255))
        for y in (top + 26, SIDE_PX - 46):
            cv2.rectangle(picture, (x, y), (right, y + 10), light, -1)
        label = np.zeros((right - x, 300, 3), np.uint8)
        write(label, str(rng.choice(_WORDS)), (6, (right - x) // 2 + 8), 0.8, (255, 255, 255), (FONT, 2))
        turned = np.rot90(label)
        spot = picture[top + 50 : top + 350, x:right]
        spot[turned[: len(spot)] > 100] = 238
        x = right + 2
    return Texture(np.clip(picture * (0.8 + 0.4 * grain(rng)[..., None]), 0, 255).astype(np.uint8))


def television(rng: np.random.Generator) -> Texture:
    """A dark frame round a landscape at dusk."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] / SIDE_PX
    sky = np.stack([0.95 - 0.5 * y, 0.45 + 0.25 * y, 0.35 + 0.45 * (1 - y)], axis=-1)
    for base, darkness in ((0.55, 0.55), (0.68, 0.35), (0.82, 0.18)):
        ridge = base + 0.16 * (noise(rng, 2, 8)[:1] - 0.5) + 0.05 * (noise(rng, 2, 64)[:1] - 0.5)
        sky = np.where(
            (y > ridge)[..., None], darkness * np.array([0.5, 0.8, 0.7]) + 0.1 * noise(rng, 128, 128)[..., None], sky
        )
    sky[np.hypot((x - 0.7) * 1.7, y - 0.3) < 0.09] = (1.0, 0.92, 0.7)
    picture = (np.clip(sky, 0, 1) * 255).astype(np.uint8)
    cv2.rectangle(picture, (0, 0), (SIDE_PX, SIDE_PX), (24, 24, 28), 26)
    return Texture(picture)


def painting(rng: np.random.Generator) -> Texture:
    """Overlapping discs and bars with a wooden frame."""
    picture = tint(0.8 + 0.35 * grain(rng), (0.92, 0.87, 0.74))
    for _ in range(26):
        x, y = (int(value) for value in rng.integers(40, SIDE_PX - 40, 2))
        ink, size = ink_of(rng.integers(20, 240, 3)), int(rng.integers(14, 74))
        if rng.random() < 0.5:
            cv2.circle(picture, (x, y), size, ink, -1 if rng.random() < 0.6 else 9, cv2.LINE_AA)
        else:
            cv2.line(picture, (x, y), (x + 2 * size, y - size), ink, 12, cv2.LINE_AA)
    strokes = 0.85 + 0.3 * noise(rng, 64, 256)[..., None]
    picture = np.clip(picture * strokes, 0, 255).astype(np.uint8)
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), (70, 44, 26), 44)
    cv2.rectangle(picture, (24, 24), (SIDE_PX - 25, SIDE_PX - 25), (188, 150, 84), 5)
    return Texture(picture)


def newspaper(rng: np.random.Generator) -> Texture:
    """A headline, a photograph and columns of small print."""
    picture = tint(0.86 + 0.2 * grain(rng), (0.9, 0.89, 0.84))
    write(picture, "THE MORNING", (24, 70), 2.2, (20, 20, 20), (FONT, 6))
    cv2.line(picture, (20, 90), (492, 90), (20, 20, 20), 4)
    photo = (60 + 150 * noise(rng, 32, 32)[:170, :220]).astype(np.uint8)
    picture[120:290, 24:244] = photo[..., None]
    for left in (24, 144, 264, 384):
        for y in range(306 if left < 244 else 124, 500, 11):
            cv2.line(picture, (left, y), (left + int(rng.integers(60, 104)), y), (70, 70, 72), 4)
    return Texture(picture)


def carton(rng: np.random.Generator, colour: Colour, word: str) -> Texture:
    """A cardboard side with tape, a label, arrows and a bar code."""
    picture = tint(0.72 + 0.5 * grain(rng), colour)
    cv2.rectangle(picture, (0, 226), (SIDE_PX, 274), (206, 184, 140), -1)
    write(picture, word, (36, 130), 2.6, (150, 26, 24), (FONT, 9))
    cv2.rectangle(picture, (40, 316), (280, 470), (240, 240, 236), -1)
    for x in range(56, 266, 6):
        cv2.line(picture, (x, 336), (x, 420), (16, 16, 16), int(rng.integers(1, 5)))
    for x in (350, 430):
        cv2.arrowedLine(picture, (x, 470), (x, 326), (30, 30, 30), 12, cv2.LINE_AA, shift=0, tipLength=0.35)
    return Texture(picture)


def panelled(rng: np.random.Generator, colour: Colour, columns: int, rows: int) -> Texture:
    """A wooden front divided into doors or drawers, each with a bevel and a knob."""
    picture = wood(rng, colour).rgb.copy()
    wide, high = SIDE_PX // columns, SIDE_PX // rows
    for row in range(rows):
        for column in range(columns):
            left, top = column * wide, row * high
            inset = min(wide, high) // 7
            cv2.rectangle(picture, (left, top), (left + wide - 1, top + high - 1), (34, 24, 18), 3)
            low, far = (left + inset, top + inset), (left + wide - inset, top + high - inset)
            shaded = picture[low[1] : far[1], low[0] : far[0]]
            shaded[:] = (shaded * 0.82).astype(np.uint8)
            cv2.rectangle(picture, low, far, (64, 46, 32), 4)
            knob = (left + wide - inset // 2 - 4, top + high // 2)
            cv2.circle(picture, knob, max(5, inset // 4), (206, 196, 170), -1, cv2.LINE_AA)
    return Texture(picture)


def fridge_front(rng: np.random.Generator) -> Texture:
    """Two steel doors with notes and magnets."""
    picture = tint(0.86 + 0.16 * noise(rng, 512, 8), (0.78, 0.8, 0.82))
    cv2.rectangle(picture, (0, 168), (SIDE_PX, 178), (40, 42, 46), -1)
    for top, bottom in ((60, 150), (200, 340)):
        cv2.rectangle(picture, (446, top), (470, bottom), (70, 74, 80), -1)
    for _ in range(9):
        x, y = int(rng.integers(30, 330)), int(rng.integers(190, 420))
        paper = ink_of(rng.integers(150, 255, 3))
        cv2.rectangle(picture, (x, y), (x + 74, y + 52), paper, -1)
        for line in range(y + 14, y + 46, 9):
            cv2.line(picture, (x + 8, line), (x + int(rng.integers(30, 66)), line), (60, 60, 80), 3)
        cv2.circle(picture, (x + 37, y + 4), 8, ink_of(rng.integers(0, 200, 3)), -1, cv2.LINE_AA)
    return Texture(picture)


def window_view(rng: np.random.Generator) -> Texture:
    """Clouds over hedges behind a white frame with four panes."""
    y = np.linspace(0, 1, SIDE_PX)[:, None]
    clouds = np.clip(noise(rng, 8, 8) + 0.5 * noise(rng, 32, 32) - 0.6, 0, 1)[..., None]
    sky = np.array([0.62, 0.78, 0.95]) * (1 - clouds) + clouds
    hedge = np.array([0.3, 0.46, 0.2]) * (0.5 + 0.9 * noise(rng, 128, 128)[..., None])
    scene = np.where((y > 0.62 + 0.16 * noise(rng, 2, 16)[:1])[..., None], hedge, sky)
    picture = (np.clip(scene, 0, 1) * 255).astype(np.uint8)
    white = (236, 234, 228)
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), white, 48)
    for a, b in (((256, 0), (256, 511)), ((0, 230), (511, 230))):
        cv2.line(picture, a, b, white, 20)
    return Texture(picture)


def calendar(rng: np.random.Generator) -> Texture:
    """A photograph above a month of numbered days."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), 240, np.uint8)
    hills = np.stack([90 + 120 * noise(rng, 8, 8), 120 + 100 * noise(rng, 16, 16), 80 + 90 * noise(rng, 64, 64)], -1)
    picture[20:220, 20:492] = hills[20:220, 20:492].astype(np.uint8)
    for day in range(31):
        row, column = divmod(day + 2, 7)
        ink = (190, 30, 30) if column == 6 else (30, 30, 36)
        write(picture, str(day + 1), (30 + 68 * column, 282 + 50 * row), 1.1, ink, (FONT, 3))
    return Texture(picture)


def rug(rng: np.random.Generator, colour: Colour) -> Texture:
    """Nested diamonds inside a border, knotted."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX]
    rings = (np.abs(x - 255.5) + np.abs(y - 255.5)) // 26
    edge = np.minimum.reduce([x, y, SIDE_PX - 1 - x, SIDE_PX - 1 - y])
    palette = np.array([colour, (0.86, 0.78, 0.6), (0.16, 0.2, 0.36), (0.66, 0.3, 0.16)])
    rgb = palette[rings.astype(np.int64) % 4]
    teeth = ((x // 16 + y // 16) % 2).astype(np.int64)
    rgb = np.where((edge < 64)[..., None], palette[2 - teeth], rgb)
    rgb = np.where((edge < 12)[..., None], palette[1], rgb)
    knots = 0.8 + 0.12 * ((x % 6 < 3) ^ (y % 6 < 3)) + 0.3 * (grain(rng) - 0.3)
    return Texture(np.clip(rgb * knots[..., None] * 255, 0, 255).astype(np.uint8))


def leaf_veins(rng: np.random.Generator) -> Texture:
    """A green leaf with a midrib and side veins."""
    picture = tint(0.6 + 0.7 * grain(rng), (0.22, 0.5, 0.2))
    pale = (150, 196, 110)
    cv2.line(picture, (256, 0), (256, 511), pale, 16, cv2.LINE_AA)
    for y in range(40, 560, 52):
        for x in (0, 511):
            cv2.line(picture, (256, y), (x, y - 110), pale, 6, cv2.LINE_AA)
    return Texture(picture)


def write(
    picture: Picture | ndarray, text: str, at: tuple[int, int], scale: float, ink: Ink, pen: tuple[int, int]
) -> None:
    """Write text from its lower left corner. pen: font and width of the lines."""
    cv2.putText(picture, text, at, pen[0], scale, ink, thickness=pen[1], lineType=cv2.LINE_AA)


def ink_of(values: ndarray) -> Ink:
    """Return red, green and blue as OpenCV expects them."""
    red, green, blue = (int(value) for value in values)
    return (red, green, blue)
