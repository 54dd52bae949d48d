"""Which named objects of a scene a task's noun means."""

from importlib import resources

import pytest

from gausslite.nouns import meant_by
from gausslite_language.nouns import usual_length_m

KITCHEN = ("chair_1", "chair_2", "stool", "table", "counter", "mug_1", "wall")


@pytest.mark.parametrize(
    ("phrase", "names", "expected"),
    [
        ("table", KITCHEN, ("table",)),
        ("desk", KITCHEN, ("table", "counter")),
        ("chair", KITCHEN, ("chair_1", "chair_2")),
        ("office chair", KITCHEN, ("chair_1", "chair_2")),
        ("chair", ("armchair", "office_chair", "stool"), ("armchair", "office_chair")),
        ("chair", ("stool", "sofa"), ("stool",)),
        ("cup", KITCHEN, ("mug_1",)),
        ("object", KITCHEN, KITCHEN[:-1]),
        ("umbrella", KITCHEN, ()),
    ],
)
def test_a_noun_means_objects_of_its_name_and_synonyms_where_there_are_none(phrase, names, expected):
    assert meant_by(phrase, names) == expected


@pytest.mark.parametrize(
    ("noun", "kinds"),
    [
        ("coffee mug", ("mug", "cup")),
        ("telephone", ("cell phone",)),
        ("armchair", ("arm chair",)),
        ("table", ("coffee table", "dining table", "desk", "counter top")),
        ("bottle", ("wine bottle",)),
    ],
)
def test_the_usual_length_is_that_of_the_noun_its_synonyms_and_its_kinds(noun, kinds):
    text = resources.files("gausslite_language").joinpath("sizes.txt").read_text(encoding="utf-8")
    rows = dict(line.split("|") for line in text.splitlines() if not line.startswith("#"))
    assert usual_length_m(noun) == max(float(rows[kind]) for kind in kinds)


@pytest.mark.parametrize("noun", ["clock", "plant", "object", "unicorn"])
def test_a_kind_without_models_or_with_few_of_its_many_kinds_has_no_usual_length(noun):
    assert usual_length_m(noun) is None
