"""Textures of devices and boards: code, slides, keys, dials, handwriting; each fitted to one face."""

from __future__ import annotations

import cv2
import numpy as np

from gausslite_sim.label_textures import DARK_INK, SMALL_FONT, any_word, paragraph
from gausslite_sim.printed_textures import FONT, ink_of, write
from gausslite_sim.textures import SIDE_PX, Texture, grain, noise, tint

_SCRIPT = cv2.FONT_HERSHEY_SCRIPT_SIMPLEX


def keys(rng: np.random.Generator) -> Texture:
    """Six rows of dark keys with letters."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), 26, np.uint8)
    letters = "QWERTYUIOPASDFGHJKLZXCVBNM1234567890"
    for row in range(6):
        count = (15, 14, 14, 13, 12, 7)[row]
        wide = SIDE_PX / count
        for k in range(count):
            low = (round(k * wide) + 3, row * 85 + 5)
            high = (round((k + 1) * wide) - 3, row * 85 + 79)
            tone = int(rng.integers(44, 66))
            cv2.rectangle(picture, low, high, (tone, tone, tone + 3), -1)
            letter = letters[(row * 7 + k) % 36]
            write(picture, letter, (low[0] + 5, low[1] + 40), 0.9, (215, 215, 220), (SMALL_FONT, 2))
    return Texture(picture)


def code_screen(rng: np.random.Generator) -> Texture:
    """An editor: a tree of files at the left, rows of coloured text."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), (22, 24, 34), np.uint8)
    cv2.rectangle(picture, (0, 0), (110, SIDE_PX), (34, 37, 50), -1)
    inks = ((120, 180, 240), (230, 150, 110), (150, 210, 130), (214, 214, 220), (200, 130, 220))
    for y in range(24, 508, 21):
        write(picture, any_word(rng), (8, y), 0.5, (150, 155, 170), (SMALL_FONT, 1))
        x = 124 + 24 * int(rng.integers(0, 4))
        while x < 430 and rng.random() < 0.86:
            word = any_word(rng)
            write(picture, word, (x, y), 0.56, inks[int(rng.integers(5))], (SMALL_FONT, 2))
            x += 13 * len(word) + 8
    return Texture(picture, gloss=0.14)


def slide_screen(rng: np.random.Generator) -> Texture:
    """A slide with a title, bars and bullet points."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), (238, 240, 244), np.uint8)
    cv2.rectangle(picture, (0, 0), (SIDE_PX, 84), (30, 62, 110), -1)
    write(picture, "QUARTER 3", (24, 62), 2.0, (250, 250, 250), (FONT, 5))
    for i in range(6):
        top = int(rng.integers(150, 400))
        cv2.rectangle(picture, (30 + 40 * i, top), (58 + 40 * i, 450), ink_of(rng.integers(40, 220, 3)), -1)
    cv2.line(picture, (24, 450), (270, 450), DARK_INK, 4)
    for y in range(150, 440, 60):
        cv2.circle(picture, (304, y - 8), 8, (200, 70, 40), -1, cv2.LINE_AA)
        paragraph(picture, rng, (324, y - 20, 500, y + 24), 22)
    return Texture(picture, gloss=0.12)


def phone_screen(rng: np.random.Generator) -> Texture:
    """Rows of coloured icons on a dark picture."""
    picture = tint(0.4 + 0.6 * noise(rng, 4, 4), (0.2, 0.3, 0.5))
    for row in range(6):
        for column in range(4):
            low = (34 + 118 * column, 40 + 78 * row)
            cv2.rectangle(picture, low, (low[0] + 84, low[1] + 54), ink_of(rng.integers(60, 250, 3)), -1)
    return Texture(picture, gloss=0.3)


def printer_front(rng: np.random.Generator) -> Texture:
    """Grey plastic with slots, lamps and a little display."""
    picture = tint(0.9 + 0.1 * grain(rng), (0.78, 0.79, 0.8))
    for y in range(200, 460, 30):
        cv2.rectangle(picture, (30, y), (482, y + 12), (52, 54, 58), -1)
    cv2.rectangle(picture, (40, 40), (240, 150), (24, 40, 56), -1)
    paragraph(picture, rng, (54, 54, 226, 140), 24, (150, 220, 240))
    for i in range(5):
        cv2.circle(picture, (290 + 42 * i, 90), 14, ink_of(rng.integers(40, 250, 3)), -1, cv2.LINE_AA)
    return Texture(picture)


def clock_face(rng: np.random.Generator) -> Texture:
    """Twelve numbers, strokes, two black hands and a red one."""
    picture = tint(0.95 + 0.06 * grain(rng), (0.95, 0.94, 0.9))
    for hour in range(1, 13):
        a = np.pi * hour / 6
        at = (round(236 + 180 * np.sin(a)) - 14 * (hour > 9), round(272 - 180 * np.cos(a)))
        write(picture, str(hour), at, 1.7, DARK_INK, (FONT, 5))
    for k in range(60):
        a = np.pi * k / 30
        ends = [(round(256 + r * np.sin(a)), round(256 - r * np.cos(a))) for r in (228, 246)]
        cv2.line(picture, ends[0], ends[1], DARK_INK, 8 if k % 5 == 0 else 3, cv2.LINE_AA)
    for tip, width, ink in (((330, 150), 16, DARK_INK), ((150, 110), 10, DARK_INK), ((300, 440), 5, (200, 30, 30))):
        cv2.line(picture, (256, 256), tip, ink, width, cv2.LINE_AA)
    return Texture(picture, gloss=0.1)


def whiteboard(rng: np.random.Generator) -> Texture:
    """Boxes, arrows, a graph and handwriting in four pens."""
    picture = tint(0.96 + 0.05 * noise(rng, 8, 32), (0.95, 0.95, 0.95))
    pens = ((30, 60, 160), (190, 30, 30), (20, 120, 60), (30, 30, 30))
    for i in range(4):
        low = (30 + 120 * i, 60 + 26 * (i % 2))
        cv2.rectangle(picture, low, (low[0] + 84, low[1] + 60), pens[i], 4, cv2.LINE_AA)
        write(picture, any_word(rng), (low[0] + 8, low[1] + 38), 0.9, pens[i], (_SCRIPT, 2))
        cv2.arrowedLine(picture, (low[0] + 86, low[1] + 30), (low[0] + 118, low[1] + 34), pens[3], 3, cv2.LINE_AA)
    cv2.polylines(
        picture, [np.array([(40, 420), (110, 330), (170, 380), (240, 250)], np.int32)], False, pens[1], 5, cv2.LINE_AA
    )
    for ends in (((36, 440), (260, 440)), ((36, 440), (36, 230))):
        cv2.arrowedLine(picture, *ends, pens[3], 4, cv2.LINE_AA)
    for y in range(240, 480, 34):
        text = " ".join(any_word(rng) for _ in range(2))
        write(picture, text, (290, y), 1.0, pens[(y // 34) % 4], (_SCRIPT, 2))
    cv2.rectangle(picture, (0, 0), (SIDE_PX - 1, SIDE_PX - 1), (150, 152, 156), 12)
    return Texture(picture, gloss=0.15)


def oven_front(rng: np.random.Generator) -> Texture:
    """Black glass with a rail, five knobs and a clock."""
    picture = tint(0.9 + 0.2 * noise(rng, 64, 8), (0.13, 0.13, 0.14))
    for x in range(60, 480, 98):
        cv2.circle(picture, (x, 60), 26, (190, 192, 196), -1, cv2.LINE_AA)
        cv2.line(picture, (x, 60), (x + 12, 40), (20, 20, 20), 6, cv2.LINE_AA)
    cv2.rectangle(picture, (30, 130), (482, 160), (180, 182, 186), -1)
    cv2.rectangle(picture, (60, 200), (452, 460), (40, 34, 30), -1)
    for y in (270, 340, 410):
        cv2.line(picture, (70, y), (442, y), (110, 104, 98), 5)
    return Texture(picture, gloss=0.3)
