"""Printed textures fitted to one face: spines, pages, labels, posters, maps, with readable text."""

from __future__ import annotations

import cv2
import numpy as np

from gausslite_sim.printed_textures import FONT, Ink, Picture, ink_of, write
from gausslite_sim.textures import SIDE_PX, Colour, Texture, grain, noise, tint

SMALL_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TITLES = ("DUNES", "FERRY", "ORBIT", "SALT", "WINTER", "GLASS", "MAPS", "TEA", "RIVERS", "LIGHT", "ROOTS", "SIGNAL")
_SYLLABLES = ("ra", "ne", "to", "li", "sa", "mu", "ke", "do", "vi", "pon", "tar", "el", "um", "is", "gra", "fel")
DARK_INK: Ink = (28, 28, 32)


def spine(rng: np.random.Generator, colour: Colour) -> Texture:
    """The back of a book: bands and a title that runs along it."""
    picture = tint(0.75 + 0.4 * grain(rng), colour)
    light = ink_of(np.clip(255 * (1.1 - np.asarray(colour)), 60, 245))
    for y in (30, 60, 450, 478):
        cv2.rectangle(picture, (0, y), (SIDE_PX, y + 12), light, -1)
    title = np.zeros((SIDE_PX, 360, 3), np.uint8)
    write(title, str(rng.choice(_TITLES)), (6, 330), 3.2, (255, 255, 255), (FONT, 12))
    turned = np.rot90(title, -1)
    picture[84 : 84 + len(turned)][turned > 110] = light[0]
    return Texture(picture)


def page(rng: np.random.Generator) -> Texture:
    """A printed sheet: a heading, a table, paragraphs."""
    picture = tint(0.92 + 0.1 * grain(rng), (0.96, 0.95, 0.92))
    write(picture, "REPORT 27", (40, 66), 1.8, DARK_INK, (FONT, 4))
    paragraph(picture, rng, (40, 96, 472, 250), 17)
    for y in range(270, 371, 25):
        cv2.line(picture, (40, y), (472, y), (90, 90, 100), 2)
    for x in (40, 150, 260, 370, 472):
        cv2.line(picture, (x, 270), (x, 370), (90, 90, 100), 2)
    paragraph(picture, rng, (40, 392, 472, 500), 17)
    return Texture(picture)


def magazine(rng: np.random.Generator, colour: Colour) -> Texture:
    """A cover with a title, an image and lines of text."""
    picture = tint(0.85 + 0.25 * grain(rng), colour)
    write(picture, "HABITAT", (24, 110), 3.3, (248, 246, 238), (FONT, 10))
    shade = noise(rng, 8, 8)[150:400, 60:452]
    picture[150:400, 60:452] = np.stack([60 + 180 * shade, 90 + 110 * shade, 150 - 80 * shade], -1).astype(np.uint8)
    cv2.circle(picture, (180, 260), 60, (244, 214, 120), -1, cv2.LINE_AA)
    paragraph(picture, rng, (60, 420, 452, 500), 24, (250, 248, 240))
    return Texture(picture, gloss=0.12)


def poster(rng: np.random.Generator, colour: Colour) -> Texture:
    """Large letters over rings, small print below, a thin black frame."""
    picture = tint(0.9 + 0.15 * grain(rng), (0.93, 0.90, 0.82))
    for radius in range(30, 170, 26):
        cv2.circle(picture, (256, 200), radius, ink_of(255 * np.asarray(colour)), 12, cv2.LINE_AA)
    write(picture, "JAZZ", (70, 250), 6.0, (190, 50, 36), (FONT, 22))
    paragraph(picture, rng, (60, 400, 452, 480), 20)
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), DARK_INK, 18)
    return Texture(picture)


def landscape(rng: np.random.Generator) -> Texture:
    """A landscape painting: hills, a lake and trees in a pale wooden frame behind glass."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] / SIDE_PX
    rgb = np.stack([0.55 + 0.3 * y, 0.7 + 0.12 * y, 0.9 - 0.1 * y], -1)
    for base, colour in ((0.42, (0.36, 0.46, 0.56)), (0.52, (0.30, 0.44, 0.34)), (0.62, (0.20, 0.34, 0.20))):
        ridge = base + 0.16 * (noise(rng, 2, 8)[:1] - 0.5) + 0.05 * (noise(rng, 2, 64)[:1] - 0.5)
        rgb = np.where((y > ridge)[..., None], np.asarray(colour) * (0.7 + 0.6 * noise(rng, 128, 128)[..., None]), rgb)
    lake = (y > 0.74 + 0.03 * np.sin(9 * x))[..., None]
    rgb = np.where(lake, np.array([0.34, 0.52, 0.66]) * (0.8 + 0.4 * noise(rng, 256, 8)[..., None]), rgb)
    picture = (np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), (206, 178, 132), 40)
    cv2.rectangle(picture, (34, 34), (SIDE_PX - 35, SIDE_PX - 35), (240, 238, 230), 20)
    return Texture(picture, gloss=0.08)


def photograph(rng: np.random.Generator) -> Texture:
    """A small portrait in a white mount."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), 236, np.uint8)
    picture[70:442, 90:422] = tint(0.5 + 0.5 * noise(rng, 8, 8), (0.5, 0.62, 0.6))[70:442, 90:422]
    cv2.ellipse(picture, (256, 420), (110, 130), 0, 180, 360, color=(66, 52, 90), thickness=-1, lineType=cv2.LINE_AA)
    cv2.circle(picture, (256, 230), 66, (214, 170, 140), -1, cv2.LINE_AA)
    cv2.ellipse(picture, (256, 200), (72, 60), 0, 180, 360, color=(60, 40, 26), thickness=-1, lineType=cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), (40, 30, 24), 36)
    return Texture(picture, gloss=0.1)


def city_map(rng: np.random.Generator) -> Texture:
    """A city map: blocks, streets, a river and names."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), (232, 228, 214), np.uint8)
    for _ in range(60):
        x, y, w, h = (int(v) for v in (*rng.integers(0, 470, 2), *rng.integers(16, 60, 2)))
        cv2.rectangle(picture, (x, y), (x + w, y + h), ink_of(rng.integers(190, 232, 3)), -1)
    river = [(int(512 * t), int(250 + 90 * np.sin(5 * t + rng.random() * 0.2))) for t in np.linspace(0, 1, 30)]
    cv2.polylines(picture, [np.array(river, np.int32)], False, (130, 176, 214), 34, cv2.LINE_AA)
    for _ in range(14):
        a, b = rng.integers(0, 512, 2), rng.integers(0, 512, 2)
        ends = ((0, int(a[0])), (511, int(b[0]))) if rng.random() < 0.5 else ((int(a[0]), 0), (int(b[0]), 511))
        cv2.line(picture, *ends, (250, 214, 130), 7, cv2.LINE_AA)
    for _ in range(22):
        at = (int(rng.integers(0, 430)), int(rng.integers(16, 500)))
        write(picture, any_word(rng).upper(), at, 0.5, (60, 60, 70), (SMALL_FONT, 1))
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), DARK_INK, 12)
    return Texture(picture)


def dotted_mug(rng: np.random.Generator, colour: Colour) -> Texture:
    """A dark mug's dots and the text HELLO."""
    picture = tint(0.85 + 0.2 * grain(rng), colour)
    for row in range(7):
        for k in range(12):
            at = (22 + 43 * k + 21 * (row % 2), 50 + 64 * row)
            cv2.circle(picture, at, 12, (246, 238, 214), -1, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 205), (SIDE_PX, 315), (240, 236, 224), -1)
    for x in (14, 270):
        write(picture, "HELLO", (x, 288), 2.3, DARK_INK, (FONT, 7))
    return Texture(picture, gloss=0.2)


def plate(rng: np.random.Generator, colour: Colour) -> Texture:
    """Rings and petals for a dish; v runs from rim to centre."""
    picture = tint(0.92 + 0.1 * grain(rng), (0.93, 0.93, 0.9))
    ink = ink_of(255 * np.asarray(colour))
    for y in (90, 330, 360):
        cv2.rectangle(picture, (0, y), (SIDE_PX, y + 12), ink, -1)
    for k in range(24):
        cv2.ellipse(picture, (10 + 21 * k, 210), (6, 60), 0, 0, 360, color=ink, thickness=-1, lineType=cv2.LINE_AA)
    return Texture(picture, gloss=0.2)


def bottle_label(rng: np.random.Generator, colour: Colour) -> Texture:
    """A paper label with a crest, a name and small print, twice round."""
    picture = tint(0.9 + 0.15 * grain(rng), (0.92, 0.88, 0.76))
    ink = ink_of(230 * np.asarray(colour))
    for x in (128, 384):
        cv2.circle(picture, (x, 110), 62, ink, 10, cv2.LINE_AA)
        cv2.line(picture, (x - 40, 150), (x + 40, 70), ink, 10, cv2.LINE_AA)
        write(picture, "CHATEAU", (x - 112, 260), 1.5, DARK_INK, (FONT, 5))
        paragraph(picture, rng, (x - 104, 290, x + 104, 440), 22)
    for y in (0, 484):
        cv2.rectangle(picture, (0, y), (SIDE_PX, y + 26), ink, -1)
    return Texture(picture)


def jar_label(rng: np.random.Generator, colour: Colour) -> Texture:
    """Preserve behind a white label."""
    picture = tint(0.6 + 0.8 * grain(rng), (0.62, 0.14, 0.16))
    for x in (30, 286):
        cv2.rectangle(picture, (x, 130), (x + 196, 390), (244, 240, 230), -1)
        cv2.rectangle(picture, (x + 10, 140), (x + 186, 380), ink_of(255 * np.asarray(colour)), 6)
        write(picture, "PLUM", (x + 22, 240), 1.9, DARK_INK, (FONT, 6))
        paragraph(picture, rng, (x + 26, 270, x + 172, 360), 26)
    return Texture(picture, gloss=0.25)


def packet(rng: np.random.Generator, colour: Colour) -> Texture:
    """A printed box or tin: a large title on a band, stripes, a bar code."""
    picture = tint(0.88 + 0.2 * grain(rng), colour)
    cv2.rectangle(picture, (0, 90), (SIDE_PX, 250), (244, 240, 226), -1)
    write(picture, str(rng.choice(_TITLES)), (24, 208), 3.2, DARK_INK, (FONT, 11))
    for y in range(280, 360, 20):
        cv2.line(picture, (0, y), (SIDE_PX, y + 30), (250, 210, 90), 8, cv2.LINE_AA)
    cv2.rectangle(picture, (300, 384), (490, 494), (246, 246, 246), -1)
    for x in range(312, 480, 7):
        cv2.line(picture, (x, 396), (x, 480), (10, 10, 10), int(rng.integers(1, 5)))
    paragraph(picture, rng, (20, 390, 280, 495), 22, (250, 248, 240))
    return Texture(picture, gloss=0.06)


def pegboard(rng: np.random.Generator) -> Texture:
    """A brown board full of holes."""
    picture = tint(0.8 + 0.35 * grain(rng), (0.66, 0.50, 0.34))
    for y in range(16, SIDE_PX, 32):
        for x in range(16, SIDE_PX, 32):
            cv2.circle(picture, (x, y), 5, (50, 36, 24), -1, cv2.LINE_AA)
    return Texture(picture)


def paragraph(
    picture: Picture, rng: np.random.Generator, box: tuple[int, int, int, int], line_px: int, ink: Ink = DARK_INK
) -> None:
    """Write rows of text inside (left, top, right, bottom)."""
    left, top, right, bottom = box
    for y in range(top + line_px, bottom, line_px):
        x = left
        while x < right - 30 and rng.random() < 0.94:
            word = any_word(rng)
            write(picture, word, (x, y - 4), line_px / 34, ink, (SMALL_FONT, max(1, line_px // 13)))
            x += round(0.58 * line_px * len(word)) + 6


def any_word(rng: np.random.Generator) -> str:
    """Return one to three random syllables."""
    return "".join(rng.choice(_SYLLABLES, int(rng.integers(1, 4))))
