"""Write src/gausslite_language/nouns.txt, the nouns of things that can be seen, from the files of WordNet 3.0.

    python3 tools/noun_vocabulary.py /usr/share/wordnet LICENSE_OF_WORDNET > src/gausslite_language/nouns.txt

The folder is that of the Debian package wordnet-base; the licence is the text that its copies must contain.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

# lexicographer files of things that can be seen
KINDS = {5: "animal", 6: "artifact", 8: "body", 13: "food", 17: "object", 18: "person", 20: "plant", 27: "substance"}
# the file of the top nouns, of which these count
TOP, TOP_WORDS = 3, ("animal", "person", "plant")
# meanings that a task in a room seldom has: a plant is no factory
RARE_KINDS, BUILDINGS = ("person", "body"), ("building", "building_complex")
# all nouns of these kinds; of the others, those that occur in WordNet's tagged texts
COMPLETE = (6, 13)
MAX_WORDS = 3


def main(folder: Path, licence: Path) -> None:
    """Print the licence as comments, then one line per synset: the lines of its hypernyms, and its words."""
    synsets = read_synsets(folder)
    frequency = word_frequency(folder)
    order = sense_order(folder, synsets, frequency)
    kept = kept_words(synsets, frequency)
    used: dict[str, None] = {}
    for offset in kept:
        visit(offset, synsets, used)
    line_of = {offset: number for number, offset in enumerate(used)}
    print(
        "# Nouns of things that can be seen, from WordNet 3.0 (tools/noun_vocabulary.py), one set of synonyms a line:"
    )
    print(
        "# the numbers of the lines of its hypernyms, counted from 0, and its words; * marks a word with another first"
    )
    print("# meaning. The licence of WordNet:\n#")
    print("\n".join(f"# {line}".rstrip() for line in licence.read_text().splitlines()))
    for offset in used:
        words = ",".join(
            word.replace("_", " ") + ("" if order[word][0] == offset else "*") for word in kept.get(offset, ())
        )
        print(" ".join(str(line_of[above]) for above in synsets[offset][2]), words, sep="|")


def read_synsets(folder: Path) -> dict[str, tuple[int, list[str], list[str]]]:
    """Return kind, words and hypernyms of each synset that is no instance, such as a town, the top ones last."""
    synsets, top = {}, {}
    for line in (folder / "data.noun").read_text().splitlines():
        if line.startswith("  "):
            continue
        fields = line.partition("|")[0].split()
        count = int(fields[3], 16)
        pointers = fields[5 + 2 * count :]
        hypernyms = [pointers[at + 1] for at in range(0, len(pointers), 4) if pointers[at] == "@"]
        kind, words = int(fields[1]), fields[4 : 4 + 2 * count : 2]
        if kind == TOP and words[0] in TOP_WORDS:
            kind = next(of for of, name in KINDS.items() if name == words[0])
            top[fields[0]] = kind, words[:1], hypernyms
        elif "@i" not in pointers:
            synsets[fields[0]] = kind, words, hypernyms
    return {**synsets, **top}


def sense_order(
    folder: Path, synsets: dict[str, tuple[int, list[str], list[str]]], frequency: Counter[str]
) -> dict[str, list[str]]:
    """Return the synsets of each word: persons, parts of the body and buildings last, before them the more frequent.

    Of two that are as frequent, one that is no plant is first: a banana is a fruit, a bulb a lamp. A person whom the
    texts mean more than ten times as often as a thing is not last: a man is seldom a piece of a game.
    """

    def is_building(offset: str) -> bool:
        _, words, above = synsets[offset]
        return words[0] in BUILDINGS or any(is_building(at) for at in above if at in synsets)

    order = {}
    for line in (folder / "index.noun").read_text().splitlines():
        if not line.startswith("  "):
            word, *fields = line.split()
            counts = {
                at: frequency[f"{word}%{n}"] for n, at in enumerate(fields[-int(fields[1]) :], 1) if at in synsets
            }
            kinds = {at: KINDS[synsets[at][0]] for at in counts if synsets[at][0] in KINDS}
            things = [counts[at] for at, kind in kinds.items() if kind not in ("person", "animal")]
            often = {at for at in kinds if kinds[at] == "person" and counts[at] > 10 * max([1, *things])}
            keys = {
                at: (at not in often and (kind in RARE_KINDS or is_building(at)), -counts[at], kind == "plant")
                for at, kind in kinds.items()
            }
            order[word] = sorted(keys, key=keys.__getitem__)
            if order[word] and kinds[order[word][0]] != "food":
                order[word][:0] = own_meaning(word, order[word][0], counts, synsets)
    return order


def own_meaning(
    word: str, chosen: str, counts: dict[str, int], synsets: dict[str, tuple[int, list[str], list[str]]]
) -> list[str]:
    """Return a thing or animal of another kind, as frequent as the chosen one, that has the word for its first name.

    A turtle is also a turtleneck, but that is called otherwise.
    """
    if synsets[chosen][1][0].lower() == word:
        return []
    kinds = {kind for kind, name in KINDS.items() if name not in ("plant", *RARE_KINDS)} - {synsets[chosen][0]}
    others = [at for at in counts if synsets[at][1][0] == word and counts[at] >= counts[chosen]]
    return [at for at in others if synsets[at][0] in kinds][:1]


def word_frequency(folder: Path) -> Counter[str]:
    """Return how often WordNet's texts have each word, and each noun with the number of its meaning: `bulb%2`."""
    frequency: Counter[str] = Counter()
    for line in (folder / "cntlist.rev").read_text().splitlines():
        key, number, count = line.split()
        word, _, rest = key.partition("%")
        frequency[word] += int(count)
        if rest.startswith("1:"):
            frequency[f"{word}%{number}"] += int(count)
    return frequency


def kept_words(synsets: dict[str, tuple[int, list[str], list[str]]], frequency: Counter[str]) -> dict[str, list[str]]:
    """Return the words of each synset that a task may name."""
    kept: dict[str, list[str]] = {}
    for offset, (kind, words, _) in synsets.items():
        if kind in KINDS:
            plain = [word.lower() for word in words if word in (word.lower(), word.upper())]  # no names
            named = [word for word in plain if word.count("_") < MAX_WORDS]
            named = [word for word in named if kind in COMPLETE or frequency[word]]
            if named:
                kept[offset] = named
    return kept


def visit(offset: str, synsets: dict[str, tuple[int, list[str], list[str]]], used: dict[str, None]) -> None:
    """Add a synset after its hypernyms."""
    if offset not in used:
        for above in synsets[offset][2]:
            visit(above, synsets, used)
        used[offset] = None


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
