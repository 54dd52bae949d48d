"""Measure the limits of `perception/text_features.py`: which LVIS nouns find a right class, and which a sibling.

Usage: python tools/calibrate_class_match.py FILE.onnx    (a YOLO-seg file with the CLIP tables next to it)

A noun's right classes are those that its LVIS synonyms, a head noun or the first words of its definition name; of all
other nouns, each class is a sibling. Nouns and classes are compared by their text features alone, without names.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from gausslite.domain.objects import head_of, normalised_noun, synonyms
from gausslite.perception.model_file import open_model
from gausslite.perception.text_features import TextEmbeddings
from gausslite.perception.yolo import load_yolo

_DEFINITION_WORDS = 7
_SIMILARITIES, _MARGINS = (0.4, 0.5, 0.55, 0.6, 0.65, 0.7), (0.0, 0.1, 0.2, 0.3)

Match = tuple[float, float, bool]


def main(path: Path) -> None:
    """Print, for each pair of limits, the accepted share of synonyms and kinds, and the siblings taken for a class."""
    embeddings, classes = TextEmbeddings.from_model_folder(path), load_yolo(open_model(path)).class_names
    if embeddings is None:
        raise SystemExit(f"{path}: expected the CLIP tables in its folder, found none")
    groups: dict[str, list[Match]] = {"synonyms": [], "kinds": [], "others": []}
    for entry in json.loads((path.parent / "lvis_v1_train_cat_info.json").read_text(encoding="utf-8")):
        names = [normalised_noun(name.split("_(")[0]) for name in (entry["name"], *entry["synonyms"])]
        synonyms, kinds = right_classes(names, entry["def"], set(classes))
        nearest = embeddings.nearest_class(names[0], classes)
        if nearest is None:
            continue
        index, similarity, margin = nearest
        group = "synonyms" if synonyms else "kinds" if kinds else "others"
        groups[group].append((similarity, margin, classes[index] in (synonyms or kinds)))
    counts = {name: len(matches) for name, matches in groups.items()}
    print(f"{counts['synonyms']} synonyms, {counts['kinds']} kinds, {counts['others']} other nouns\n")
    print("| similarity | margin | synonyms right | kinds right | wrong class (synonyms and kinds) | others accepted |")
    print("|---:|---:|---:|---:|---:|---:|")
    for min_similarity in _SIMILARITIES:
        for min_margin in _MARGINS:
            accepted = {
                name: [is_right for s, m, is_right in matches if s >= min_similarity and m >= min_margin]
                for name, matches in groups.items()
            }
            right = [f"{sum(accepted[name]) / counts[name]:.2f}" for name in ("synonyms", "kinds")]
            wrong = sum(not is_right for name in ("synonyms", "kinds") for is_right in accepted[name])
            print(f"| {min_similarity} | {min_margin} | {' | '.join(right)} | {wrong} | {len(accepted['others'])} |")


def right_classes(names: list[str], definition: str, classes: set[str]) -> tuple[set[str], set[str]]:
    """Return the classes that are synonyms of a noun, and those of which it is a kind."""
    words = definition.replace(",", " ").split()[:_DEFINITION_WORDS]
    heads = {head_of(name) for name in names} | {synonyms().get(name, "") for name in names}
    return classes & set(names), classes & (heads | set(words))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]))
