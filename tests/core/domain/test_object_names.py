"""Which named objects of a scene a task's noun means."""

from __future__ import annotations

import pytest

from gausslite.domain.objects import meant_by

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
