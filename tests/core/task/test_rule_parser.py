"""The rule parser on hand-written sentences, and on text that is not a task."""

from __future__ import annotations

import json
import time

import pytest

from gausslite.domain.errors import TaskError
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.domain.task_limits import require_graph
from gausslite.task import lexicon
from gausslite.task.nouns import COMMON_ANCHORS
from gausslite.task.parser import task_id_of
from gausslite.task.rules import RuleParser
from gausslite.task.singular import singular
from gausslite_bench.parser_scores import SENTENCES as BENCH_SENTENCES

SENTENCES = json.loads(BENCH_SENTENCES.read_text(encoding="utf-8"))
PAPER_SENTENCES = 6


def as_row(text: str) -> dict[str, object]:
    graph = RuleParser().parse(text)
    relations = [[str(each.predicate), each.target, each.anchor] for each in graph.relations]
    return {"text": text, "targets": list(graph.targets), "anchors": list(graph.anchors), "relations": relations}


def as_sets(row: dict[str, object]) -> tuple[set[str], set[str], set[tuple[str, ...]]]:
    """Return sets, because the order in a graph is irrelevant."""
    return set(row["targets"]), set(row["anchors"]), {tuple(relation) for relation in row["relations"]}


@pytest.mark.parametrize("row", SENTENCES[:PAPER_SENTENCES], ids=lambda row: row["text"])
def test_the_papers_tasks(row):
    assert as_row(row["text"]) == row


def test_graphs_of_ordinary_sentences_are_exact():
    wrong = [row["text"] for row in SENTENCES if as_sets(as_row(row["text"])) != as_sets(row)]
    share = 1 - len(wrong) / len(SENTENCES)
    print(f"exact graphs: {share:.1%} of {len(SENTENCES)}; wrong: {wrong}")
    assert len(SENTENCES) >= 600
    assert share >= 0.95, wrong


FRAMES = [
    "Clean the {}",
    "Find the {} on the shelf",
    "Bring me the red {} and the glorb",
    "Where is the {}?",
    "Is the {} under the shelf broken?",
    "Put the {} next to the shelf",
]


@pytest.mark.parametrize("at", range(len(FRAMES)))
def test_every_known_noun_is_parsed_as_a_noun(at):
    no_objects = lexicon.PLACES | lexicon.MEASURES | lexicon.ADDRESSEES | lexicon.ROUTES | lexicon.TASK_NOUNS
    parser, adjective = RuleParser(), "red " if "red" in FRAMES[at] else ""
    for noun in sorted(lexicon.NOUNS - no_objects - lexicon.ADJECTIVES)[at :: len(FRAMES)]:
        assert adjective + singular(noun) in parser.parse(FRAMES[at].format(noun)).targets


def test_a_sentence_takes_less_than_10_ms():
    parser = RuleParser()
    parser.parse("warm up the table")
    durations = []
    for row in SENTENCES:
        started = time.thread_time()  # excludes time of other processes
        parser.parse(row["text"])
        durations.append(time.thread_time() - started)
    assert sorted(durations)[len(durations) // 2] < 0.010


@pytest.mark.parametrize(
    "text",
    ["", "   ", "asdf qwer", "pick up", "go and clean", "!?!", "12 34", "please", "Do not touch the vase", "red"],
)
def test_text_without_an_object_is_refused_in_one_line(text):
    with pytest.raises(TaskError, match=r"expected .* names an object, such as") as caught:
        RuleParser().parse(text)
    assert "\n" not in str(caught.value)


def test_bytes_of_another_encoding_are_refused():
    with pytest.raises(TaskError, match="expected UTF-8"):
        RuleParser().parse("find the m\udcffg")


def test_text_that_is_too_long_is_refused():
    with pytest.raises(TaskError, match="at most 1000 characters, got 1001"):
        RuleParser().parse("a" * 1001)


def test_too_many_objects_are_refused():
    names = ", the ".join(
        f"{colour} {noun}" for colour in ("red", "blue", "green") for noun in sorted(COMMON_ANCHORS)[:6]
    )
    with pytest.raises(TaskError, match="at most 16 objects, got 18"):
        RuleParser().parse(f"Find the {names}")


def test_a_phrase_that_is_too_long_is_refused():
    with pytest.raises(TaskError, match="at most 64 characters"):
        RuleParser().parse("Find the " + "x" * 70)


@pytest.mark.parametrize(
    ("text", "excluded"),
    [
        ("Pick up the mug without touching the vase", "vase"),
        ("Ignore people and map the chairs", "person"),
        ("Go to the door without bumping into the table", "table"),
        ("Map the chairs except the stool", "stool"),
        ("Don't touch the lamp, pick up the book", "lamp"),
        ("Clean the desk but leave the laptop alone", "laptop"),
        ("Be careful not to break the bowl and pick up the spoon", "bowl"),
    ],
)
def test_excluded_objects_are_no_targets_with_a_warning(text, excluded):
    graph = RuleParser().parse(text)
    assert excluded not in graph.queries
    assert any(repr(excluded) in warning for warning in graph.warnings)


@pytest.mark.parametrize(
    ("text", "targets", "anchors"),
    [
        ("Pick this up", ("object",), ()),
        ("Put that on the tray", ("object",), ("tray",)),
        ("Leave it on the porch", ("object",), ("porch",)),
        ("Clean them", ("object",), ()),
    ],
)
def test_a_demonstrative_means_any_object_with_a_warning(text, targets, anchors):
    graph = RuleParser().parse(text)
    assert (graph.targets, graph.anchors) == (targets, anchors)
    assert "refers to no named object" in graph.warnings[0]


@pytest.mark.parametrize(
    ("text", "relations"),
    [
        ("Go to the desk and take the mug on it", (Relation(Predicate.ON, "mug", "desk"),)),
        ("Clean the table and everything on it", (Relation(Predicate.ON, "object", "table"),)),
        ("Find the vase and put it on the shelf", ()),
        ("Take the vase on the desk and wipe it", (Relation(Predicate.ON, "vase", "desk"),)),
    ],
)
def test_pronouns_refer_to_named_objects(text, relations):
    graph = RuleParser().parse(text)
    assert graph.relations == relations
    assert graph.warnings == ()


@pytest.mark.parametrize("predicate", sorted(set(Predicate) - {Predicate.BETWEEN}))
def test_every_predicate_has_a_preposition(predicate):
    graph = RuleParser().parse(f"Find the mug {predicate.replace('_', ' ')} the table")
    assert graph.relations == (Relation(predicate, "mug", "table"),)


def test_an_unknown_relation_becomes_near_with_a_warning():
    graph = RuleParser().parse("Find the shoe opposite the couch")
    assert graph.relations == (Relation(Predicate.NEAR, "shoe", "couch"),)
    assert graph.warnings == ("'opposite' 'couch' is not a known relation: treated as near",)


def test_far_from_does_not_become_near():
    graph = RuleParser().parse("Find the chair far from the door")
    assert graph.relations == ()
    assert graph.anchors == ("door",)
    assert len(graph.warnings) == 1


def test_spellings_of_one_task_have_one_id():
    assert task_id_of("Pick up  the Mug.") == task_id_of("pick up the mug")
    assert task_id_of("pick up the mug") != task_id_of("pick up the cup")
    assert len(task_id_of("x")) == 12


@pytest.mark.parametrize(
    ("plural", "one"),
    [
        ("chairs", "chair"), ("boxes", "box"), ("people", "person"), ("shelves", "shelf"), ("dishes", "dish"),
        ("batteries", "battery"), ("vases", "vase"), ("glass", "glass"), ("cactus", "cactus"), ("tomatoes", "tomato"),
        ("scissors", "scissors"), ("cookies", "cookie"), ("buses", "bus"), ("shoes", "shoe"), ("knives", "knife"),
    ],
)  # fmt: skip
def test_singulars(plural, one):
    assert singular(plural) == one


def test_the_validator_refuses_relations_between_unknown_nouns():
    graph = TaskGraph("id", "mug", ("mug",), (), (Relation(Predicate.ON, "mug", "table"),))
    with pytest.raises(TaskError, match="expected one of the anchors last, got 'table'"):
        require_graph(graph)
