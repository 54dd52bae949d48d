"""Make a graph of what a parser found, and keep nothing in it that the sentence does not say."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gausslite.domain.task import Relation, TaskGraph
from gausslite.errors import TaskError
from gausslite.task import lexicon
from gausslite.task.chunker import read
from gausslite.task.graph_builder import build_draft
from gausslite.task.graph_draft import GraphDraft
from gausslite.task.noun_phrase import noun_phrase
from gausslite.task.parser import normalise_text, task_id_of
from gausslite.task.singular import singular
from gausslite.task.tokenizer import tokenize
from gausslite.task.validate import EXAMPLE, LIMITS, require_graph, require_task_text
from gausslite.task.word_set import word_set

# words for any object: they, or a place, a "this" or an "everything" in the sentence, entail one another
_ANY_OBJECT = (
    lexicon.GENERIC
    | lexicon.PLACES
    | lexicon.ROOMS
    | {word for word, noun in lexicon.INDEFINITE_PRONOUNS.items() if noun == "object"}
    | word_set("this that these those it them one ones whatever everywhere")
)
_SYNONYMS = tuple(
    word_set(line)
    for line in (
        "sofa couch", "fridge refrigerator", "tv television", "bike bicycle", "phone cellphone telephone smartphone",
        "trash garbage rubbish litter waste", "tap faucet", "cupboard cabinet", "rug carpet", "elevator lift",
        "mug cup",
        "laptop notebook computer", "bin can", "photo picture", "shelf bookshelf", "purse handbag", "plane airplane",
    )
)  # fmt: skip
_ARTICLES = word_set("a an the this that these those my your his her its our their some any all every each")


def grounded_graph(
    text: str,
    targets: Sequence[str],
    anchors: Sequence[str],
    relations: Sequence[Relation],
    warnings: Sequence[str] = (),
    draft: GraphDraft | None = None,
) -> TaskGraph:
    """The one way from any parser's answer to a task graph.

    Phrases lose their article and plural. A target or anchor whose head noun the sentence neither contains nor entails
    is dropped, a target that the sentence says to leave alone, and a relation between nouns that are not listed;
    `warnings` names them. The rules hand over their own `draft`; for other parsers it is read here. Raises TaskError
    when the text is no task, no target is left, or the graph is out of bounds.
    """
    require_task_text(text)
    said, notes = _sentence_words(text), list(warnings)
    draft = draft or build_draft(read(normalise_text(text)))
    kept_targets = _without_excluded(draft, _mentioned("target", targets, said, notes.append), notes.append)
    kept_anchors = _mentioned("anchor", anchors, said, notes.append)
    if not kept_targets:
        shown = " ".join(text.split())[:60]
        raise TaskError(
            f"task targets: expected at least one object of the sentence, such as in {EXAMPLE}, got {shown!r}"
        )
    graph = TaskGraph(
        task_id=task_id_of(text),
        text=text.strip(),
        targets=kept_targets,
        anchors=kept_anchors,
        relations=_valid_relations(relations, kept_targets, kept_anchors, notes.append),
        warnings=tuple(notes[: LIMITS.max_warnings]),
    )
    require_graph(graph)
    return graph


def _mentioned(role: str, phrases: Sequence[str], said: frozenset[str], note: Callable[[str], None]) -> tuple[str, ...]:
    """The phrases whose head the sentence says or entails, plain and once."""
    kept: dict[str, None] = {}
    for phrase in phrases:
        noun = plain_phrase(phrase)
        if _is_mentioned(noun, said):
            kept[noun] = None
        else:
            note(f"{role} {_abbreviate(phrase)} is not in the sentence: it is dropped")
    return tuple(kept)


def _without_excluded(draft: GraphDraft, targets: tuple[str, ...], note: Callable[[str], None]) -> tuple[str, ...]:
    """The targets without those that the rules read as to be left alone; "mug" stays where only "the blue mug" is."""
    kept: list[str] = []
    for target in targets:
        forbidden = any(_may_be_same_object(target, phrase) for phrase in draft.excluded)
        if forbidden and not any(_may_be_same_object(target, wanted) for wanted in draft.targets):
            note(f"target {_abbreviate(target)} is to be left alone: it is dropped")
        else:
            kept.append(target)
    return tuple(kept)


def _may_be_same_object(one: str, other: str) -> bool:
    """True where one phrase is the other, or the other with more words before it."""
    return f" {one}".endswith(f" {other}") or f" {other}".endswith(f" {one}")


def plain_phrase(phrase: str) -> str:
    """A noun phrase as a detector gets it: lower case, no article, the head in the singular, nothing after "of"."""
    tokens = normalise_text(phrase).split(" of ")[0].split()
    while len(tokens) > 1 and tokens[0] in _ARTICLES:
        tokens = tokens[1:]
    return noun_phrase(tokens, False, False).text if tokens else ""


def _valid_relations(
    relations: Sequence[Relation], targets: tuple[str, ...], anchors: tuple[str, ...], note: Callable[[str], None]
) -> tuple[Relation, ...]:
    kept: dict[Relation, None] = {}
    for each in relations:
        relation = Relation(each.predicate, plain_phrase(each.target), plain_phrase(each.anchor))
        if relation.target in targets and relation.anchor in anchors:
            kept[relation] = None
        else:
            note(
                f"{each.predicate} joins {_abbreviate(each.target)} to {_abbreviate(each.anchor)}, not both known: it is dropped"
            )
    return tuple(kept)


def _abbreviate(phrase: str) -> str:
    return repr(phrase[: LIMITS.max_phrase_chars])


def _sentence_words(text: str) -> frozenset[str]:
    """Every word of a sentence as it stands and in the singular, the parts of hyphenated words too."""
    tokens = tokenize(normalise_text(text).replace("-", " ")) + normalise_text(text).split()
    bare = [token.strip(".,;:!?()\"'").removesuffix("'s") for token in tokens]
    return frozenset(bare) | frozenset(singular(token) for token in bare) | frozenset(tokens)


def _is_mentioned(phrase: str, said: frozenset[str]) -> bool:
    head = phrase.split()[-1] if phrase else ""
    if not head:
        return False
    if head in said or head.split("-")[-1] in said:
        return True
    if head in lexicon.GENERIC:
        return bool(said & _ANY_OBJECT)
    if head == "person":
        return bool(said & lexicon.PEOPLE)
    return any(head in group and said & group for group in _SYNONYMS)
