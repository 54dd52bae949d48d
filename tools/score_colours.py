#!/usr/bin/env python3
"""Score colour words on objects of the simulated homes: which are counted, which are left out.

    tools/score_colours.py [--homes 2,4,6,8] [--frames 16] [--size 480x360] [--gains 1.15,1,0.87]

The labels in home_colours.txt were read from pictures. Words that would do are not scored; all other words are wrong.
The ranges of `perception/colours.py` were set on the homes 1, 3, 5 and 7; the others were not used.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import gausslite as gl
from gausslite.perception.selector import Fit
from gausslite_selection.colours import basic_terms, mask_colours, match_colour, no_colours

_LABELS = Path(__file__).with_name("home_colours.txt")
_MIN_PIXELS = 80


@dataclass
class WordScore:
    """Decisions about the objects that have a colour, and about those that do not."""

    right: dict[Fit, int] = field(default_factory=lambda: dict.fromkeys(Fit, 0))
    wrong: dict[Fit, int] = field(default_factory=lambda: dict.fromkeys(Fit, 0))


def read_labels(path: Path = _LABELS) -> dict[tuple[int, str], tuple[set[str], set[str]]]:
    """Return the right words, and those that would do, by home and object."""
    labels = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            place, right, possible = line.split("|")
            home, name = place.split()
            labels[int(home), name] = set(right.split()), set(possible.split())
    return labels


def object_colours(home: int, frames: int, size: str, gains: tuple[float, ...]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each object of a home with the sums of its colours over all frames that show it."""
    source = gl.open_sequence(f"sim:home-{home}?frames={frames}&size={size}")
    sums: dict[str, np.ndarray] = {}
    for index in range(frames):
        frame = source.frame(index)
        frame = replace(frame, rgb=np.clip(frame.rgb * np.array(gains), 0, 255).astype(np.uint8))
        for name, region in source.regions().items():
            mask = region.mask(frame)
            if np.count_nonzero(mask) >= _MIN_PIXELS:
                sums[name] = sums.get(name, no_colours()) + mask_colours(mask, frame)
    yield from sums.items()


def score(homes: list[int], frames: int, size: str, gains: tuple[float, ...]) -> dict[str, WordScore]:
    """Return the score of each basic colour term."""
    labels, scores = read_labels(), {term: WordScore() for term in basic_terms()}
    for home in homes:
        for name, colours in object_colours(home, frames, size, gains):
            right, possible = labels.get((home, name), (set(), set(basic_terms())))
            for term in set(basic_terms()) - possible:
                outcome = scores[term].right if term in right else scores[term].wrong
                outcome[match_colour(term, colours)] += 1
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--homes", default="1,2,3,4,5,6,7,8", help="numbers of the homes")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--gains", default="1,1,1", help="gains of red, green and blue, as a wrong white balance")
    options = parser.parse_args()
    gains = tuple(float(gain) for gain in options.gains.split(","))
    scores = score([int(home) for home in options.homes.split(",")], options.frames, options.size, gains)
    print("| word | objects of it | counted | surely | other objects | left out | surely counted | precision of sure |")
    total = WordScore()
    for term, word_score in scores.items():
        for match in Fit:
            total.right[match] += word_score.right[match]
            total.wrong[match] += word_score.wrong[match]
        print(_row(term, word_score))
    print(_row("all", total))


def _row(word: str, word_score: WordScore) -> str:
    right, wrong = sum(word_score.right.values()), sum(word_score.wrong.values())
    counted, left_out = right - word_score.right[Fit.NO], word_score.wrong[Fit.NO]
    sure, wrongly_sure = word_score.right[Fit.YES], word_score.wrong[Fit.YES]
    precision = f"{sure / (sure + wrongly_sure):.2f}" if sure + wrongly_sure else "-"
    return f"| {word} | {right} | {counted} | {sure} | {wrong} | {left_out} | {wrongly_sure} | {precision} |"


if __name__ == "__main__":
    main()
