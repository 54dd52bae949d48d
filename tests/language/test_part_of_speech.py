"""Part-of-speech tags depend on neighbouring words; the Viterbi path has the least cost of all paths."""

import itertools
from collections.abc import Mapping, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite_language.clause_types import ClauseType, clause_types
from gausslite_language.grounding import normalise_text
from gausslite_language.tags import TRANSITION_COSTS, Tag, best_tags, tag_words
from gausslite_language.tokens import lexical_units
from gausslite_language.verbs import VERBS, base_of_ed, base_of_ing, base_of_s, verb_base

TAGS = st.sampled_from(sorted(Tag, key=lambda tag: tag.value))
OPTIONS = st.dictionaries(TAGS, st.integers(0, 40), min_size=1, max_size=3)


def path_cost(candidates: Sequence[Mapping[Tag, int]], path: Sequence[Tag]) -> int:
    own = sum(options[tag] for options, tag in zip(candidates, path, strict=True))
    return own + sum(TRANSITION_COSTS[before][after] for before, after in itertools.pairwise([None, *path, None]))


def tags_of(text: str) -> dict[str, Tag]:
    return dict(tag_words(lexical_units(normalise_text(text))))


@given(st.lists(OPTIONS, max_size=5))
def test_the_path_has_the_least_cost(candidates):
    found = best_tags(candidates)
    assert len(found) == len(candidates)
    assert path_cost(candidates, found) == min(path_cost(candidates, path) for path in itertools.product(*candidates))


@pytest.mark.parametrize(
    ("text", "word", "tag"),
    [
        ("Water the plant", "water", Tag.VERB), ("Bring the plant some water", "water", Tag.NOUN),
        ("Clean the light", "light", Tag.NOUN), ("Light the candles", "light", Tag.VERB),
        ("Take out the light box", "light", Tag.ADJECTIVE), ("Find the dustpan and dust the shelf", "dust", Tag.VERB),
        ("Wipe off the dust", "dust", Tag.NOUN), ("Take the laundry out and fold it", "fold", Tag.VERB),
        ("Go to the bus stop", "stop", Tag.NOUN), ("The mugs on the rack belong in the cupboard", "belong", Tag.VERB),
        ("Which shelf holds the cans", "holds", Tag.VERB), ("Empty the trash can by the door", "can", Tag.NOUN),
        ("Can you open the door", "can", Tag.AUXILIARY), ("Go to the charging station", "charging", Tag.NOUN),
        ("Find the person holding a cup", "holding", Tag.GERUND),
        ("Someone left a pram in the hall", "left", Tag.PARTICIPLE), ("Open the left drawer", "left", Tag.ADJECTIVE),
        ("Find the mug that is on the desk", "that", Tag.RELATIVE), ("Bring that mug", "that", Tag.DETERMINER),
        ("Glorb the wug", "glorb", Tag.VERB), ("Bring the glorb", "glorb", Tag.NOUN),
    ],
)  # fmt: skip
def test_a_tag_depends_on_neighbouring_words(text, word, tag):
    assert tags_of(text)[word] is tag


@pytest.mark.parametrize(
    ("text", "types"),
    [
        ("Close the curtains, the sun is strong", [ClauseType.REQUEST, ClauseType.STATEMENT]),
        ("The bin is full, empty it", [ClauseType.STATEMENT, ClauseType.REQUEST]),
        ("Close the door because the dog is out", [ClauseType.REQUEST, ClauseType.REASON]),
        ("Turn off the lamp so that the baby can sleep", [ClauseType.REQUEST, ClauseType.REASON]),
        ("If the door is open, close it", [ClauseType.REQUEST, ClauseType.REQUEST]),
        ("Keep the door open while I carry the sofa in", [ClauseType.REQUEST, ClauseType.STATEMENT]),
        ("Bring the hammer. And the nails", [ClauseType.REQUEST, ClauseType.REQUEST]),
        ("Close the window. The baby is asleep", [ClauseType.REQUEST, ClauseType.STATEMENT]),
        ("Where is the mug", [ClauseType.REQUEST]),
        ("I think the mug is on the table", [ClauseType.STATEMENT]),
        ("I need the mug", [ClauseType.REQUEST]),
        ("The mugs go in the cupboard", [ClauseType.REQUEST]),
        ("Bring the mug and the plate", [ClauseType.REQUEST]),
        ("Bring the mug and fetch the plate", [ClauseType.REQUEST, ClauseType.REQUEST]),
    ],
)
def test_clause_types(text, types):
    assert list(clause_types(tag_words(lexical_units(normalise_text(text)))).values()) == types


def test_regular_forms_have_a_known_base():
    for verb in VERBS:
        stem = verb.removesuffix("e")
        present = (verb.removesuffix("ie") + "y" if verb.endswith("ie") else stem) + "ing"
        assert verb_base(verb) == verb
        for form, base_of in ((verb + "s", base_of_s), (present, base_of_ing), (stem + "ed", base_of_ed)):
            assert base_of(form) in VERBS, form


@pytest.mark.parametrize(
    ("form", "base"),
    [
        ("carries", "carry"), ("carried", "carry"), ("dropping", "drop"), ("placing", "place"), ("lying", "lie"),
        ("washes", "wash"), ("left", "leave"), ("hung", "hang"), ("stood", "stand"), ("table", None), ("red", None),
    ],
)  # fmt: skip
def test_verb_forms(form, base):
    assert verb_base(form) == base
