"""Answers of language models are grounded in the sentence; otherwise the rules parse the task."""

import json
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.errors import InvalidInputError, LanguageModelError, TaskError
from gausslite.domain.task import Predicate, Relation, TargetRole, require_graph
from gausslite_language.backends import HttpBackend, ModelSettings, OnnxBackend
from gausslite_language.models.http import HttpSettings
from gausslite_language.models.parsers import (
    MAX_PHRASES,
    MAX_RELATIONS,
    CachedParser,
    FallbackParser,
    LanguageParser,
    Message,
    MessageRole,
    messages_for,
    parse_answer,
)
from gausslite_language.rules import RuleParser

TASK = "Pick up the mugs on the table"


def answer(targets: object = ("mug",), anchors: object = ("table",), *relations: object) -> str:
    return json.dumps({"targets": targets, "anchors": anchors, "relations": relations})


def relation(predicate: str = "on", target: str = "mug", anchor: str = "table") -> dict[str, str]:
    return {"predicate": predicate, "target": target, "anchor": anchor}


class ScriptedModel:
    """A model that returns a given answer, or fails."""

    version = "1"

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.requests: list[Sequence[Message]] = []

    def complete(self, messages: Sequence[Message]) -> str:
        self.requests.append(messages)
        if not self.answers:
            raise LanguageModelError("language model: no answer")
        return self.answers.pop(0)


def test_a_correct_answer_equals_the_graph_of_the_rules():
    assert parse_answer(TASK, answer(["The mugs"], ["the table"], relation())) == RuleParser().parse(TASK)


@pytest.mark.parametrize(
    ("task", "targets", "kept"),
    [
        ("Pick up the mug and ignore the vase", ["mug", "vase"], ("mug",)),
        ("Map the chairs except the stool", ["chair", "stools"], ("chair",)),
        ("Clean the desk but skip the old laptop", ["desk", "laptop"], ("desk",)),
        ("Ignore the glass, bring the plastic cup", ["plastic cup", "glass"], ("plastic cup",)),
        ("Take the red mug, not the blue mug", ["mug"], ("mug",)),
        ("Take the red mug, not the blue mug", ["red mug", "blue mug"], ("mug",)),
        ("Take everything off the table except the tray", ["object", "tray"], ("object",)),
        ("Avoid the trash cans", ["trash can"], ("trash can",)),
    ],
)
def test_a_target_that_the_sentence_excludes_is_dropped_and_named(task, targets, kept):
    graph = parse_answer(task, answer(targets, []))
    assert graph.targets == kept
    dropped = [warning for warning in graph.warnings if "is to be left alone: it is dropped" in warning]
    assert len(dropped) == len(targets) - len(kept)


def test_an_answer_of_excluded_objects_alone_is_refused():
    with pytest.raises(LanguageModelError, match="expected at least one object"):
        parse_answer("Pick up the mug, not the vase", answer(["vase"], []))


def test_roles_negations_and_distances_of_an_answer_are_kept():
    task = "Put the mug that is within 2 m of the door and not on the table into the red box, ignore the cat"
    near = {**relation("near", anchor="door"), "max_m": 2, "min_m": None, "negated": False}
    not_on = {**relation(), "negated": True}
    value = {"targets": ["mug"], "destinations": ["red box"], "anchors": ["door", "table"], "excluded": ["cat"]}
    graph = parse_answer(task, json.dumps({**value, "relations": [near, not_on]}))
    assert graph.is_equivalent_to(RuleParser().parse(task))
    assert graph.warnings == ()


def test_the_rules_correct_an_answer_that_reverses_the_sentence():
    graph = parse_answer("Find the mug that is not on the table", answer(["mug"], ["table"], relation()))
    assert graph.relations == (Relation(Predicate.ON, "mug", "table", negated=True),)
    assert "contradicts the sentence" in graph.warnings[0]
    graph = parse_answer("Take the mug without touching the vase", answer(["mug", "vase"], []))
    assert graph.roles[graph.targets.index("vase")] is TargetRole.OBSTACLE


def test_an_answer_within_prose_is_found():
    text = f"Sure! Here it is:\n```json\n{answer()}\n```\nAnything else? {{}}"
    assert parse_answer(TASK, text).targets == ("mug",)


def test_an_invented_object_is_dropped_and_named():
    graph = parse_answer(TASK, answer(["mug", "dragon"], ["table", "castle"], relation(), relation(anchor="castle")))
    assert (graph.targets, graph.anchors) == (("mug",), ("table",))
    assert graph.relations == (Relation(Predicate.ON, "mug", "table"),)
    assert [name for name in ("dragon", "castle") if any(repr(name) in warning for warning in graph.warnings)] == [
        "dragon", "castle",
    ]  # fmt: skip
    assert len(graph.warnings) == 3


@pytest.mark.parametrize(
    ("task", "target"),
    [
        ("Tidy the couch", "sofa"),
        ("Is anyone here?", "person"),
        ("Clean this up", "object"),
        ("Explore the kitchen", "object"),
        ("Pick up the t-shirts", "t-shirt"),
        ("Fill the kid's bottle of water", "bottle of water"),
        ("Wipe the coffee-table", "table"),
    ],
)
def test_a_noun_that_the_sentence_implies_is_kept(task, target):
    graph = parse_answer(task, answer([target], []))
    assert len(graph.targets) == 1
    assert graph.warnings == ()


@pytest.mark.parametrize(
    "text",
    [
        "", "no idea", "{", "{}", "[]", "null", answer(["dragon"], []), answer([], []), answer("mug", []),
        answer([3], []), answer([""], []), answer(["mug\u0000"], []), answer(["mug" * 40], []),
        answer(["mug"] * (MAX_PHRASES + 1), []), answer(["mug"], ["table"], *[relation()] * (MAX_RELATIONS + 1)),
        answer(["mug"], ["table"], relation("beneath")), answer(["mug"], ["table"], {"predicate": "on"}),
        answer(["mug"], ["table"], {**relation(), "predicate": ["on"]}), answer(["mug"], ["table"], "on"),
        '{"targets": ["mug"], "anchors": [], "relations": [], "note": ""}', '{"targets": ' + "[" * 60_000,
        '{"targets": ' + "9" * 10_000 + "}", "x" * 70_000,
    ],
)  # fmt: skip
def test_nonsense_falls_back_to_rules_with_a_warning(text):
    graph = FallbackParser(LanguageParser(ScriptedModel(text)), "http", RuleParser()).parse(TASK)
    assert graph.relations == (Relation(Predicate.ON, "mug", "table"),)
    assert graph.warnings[0].startswith("backend http failed (language model")
    assert graph.warnings[0].isprintable()
    assert len(graph.warnings[0]) < 400


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=50) | st.sampled_from(("mug", "table", "on", "near")),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=12,
)
PHRASES = st.lists(st.text(max_size=45) | st.sampled_from(("mug", "the mugs", "table", "vase")), max_size=9)
ROWS = st.lists(
    st.fixed_dictionaries(
        {
            "predicate": st.sampled_from((*Predicate, "within")),
            "target": st.sampled_from(("mug", "vase", "")),
            "anchor": st.sampled_from(("table", "Table", "mug")),
        }
    ),
    max_size=4,
)
SHAPED = st.fixed_dictionaries({"targets": PHRASES | JSON, "anchors": PHRASES, "relations": ROWS | JSON})


@given(st.text(max_size=300) | JSON.map(json.dumps) | SHAPED.map(json.dumps))
def test_any_answer_gives_a_graph_of_the_sentence_or_is_refused(text):
    try:
        graph = parse_answer(TASK, text)
    except LanguageModelError as error:
        message = str(error)
    else:
        require_graph(graph)
        message = ""
        assert {phrase.split()[-1] for phrase in graph.queries} <= {"mug", "table", "pick", "up", "the", "on"}
    assert "\n" not in message


def test_an_invalid_task_is_refused_before_the_model_is_called():
    model = ScriptedModel(answer())
    pytest.raises(TaskError, LanguageParser(model).parse, "!?").match("names an object")
    assert model.requests == []


def test_answers_are_cached_failures_are_not_and_the_cache_is_bounded():
    model = ScriptedModel(answer())
    parser = CachedParser(LanguageParser(model), "http", "1", capacity=1)
    assert parser.parse(TASK) is parser.parse(TASK)
    assert len(model.requests) == 1
    for _ in range(2):
        pytest.raises(LanguageModelError, parser.parse, "Find the table")
    model.answers = [answer(["table"], []), answer(["mug"], [])]
    parser.parse("Find the table")
    parser.parse(TASK)
    assert len(model.requests) == 5


def test_the_prompts_own_examples_are_graphs_by_its_own_schema():
    messages = messages_for("Find the mug")
    assert messages[0].role is MessageRole.SYSTEM
    assert messages[-1] == Message(MessageRole.USER, "Find the mug")
    shots = list(zip(messages[1:-1:2], messages[2:-1:2], strict=True))
    assert len(shots) >= 4
    for request, response in shots:
        assert parse_answer(request.text, response.text).warnings == ()


@pytest.mark.parametrize(
    ("backend", "settings", "expected"),
    [
        (HttpBackend, {}, "expected --llm-model"),
        (OnnxBackend, {}, "expected --llm-model"),
        (HttpBackend, {"model": "m"}, "expected --llm-url"),
        (
            HttpBackend,
            {"model": "m", "url": "http://h", "timeout_s": float("nan")},
            "up to 600 seconds, got nan",
        ),
        (HttpBackend, {"model": "m", "url": "ftp://host"}, "backend http url"),
        (HttpBackend, {"model": "m", "url": "http://me:secret@host/v1"}, "no user, password"),
        (HttpBackend, {"model": "m", "url": "http://host", "key_variable": "WRONG_KEY"}, "backend http key"),
        (OnnxBackend, {"model": "/nowhere"}, "/nowhere: expected a folder with genai_config.json"),
    ],
)
def test_wrong_settings_are_refused(backend, settings, expected, monkeypatch):
    monkeypatch.setenv("WRONG_KEY", "secret\nb")
    with pytest.raises(InvalidInputError, match=expected) as caught:
        backend(ModelSettings(**settings)).open()
    assert "secret" not in str(caught.value)


def test_the_key_is_never_in_the_repr():
    assert "secret" not in repr(HttpSettings("http://host", "m", api_key="secret"))
