"""Turn a parser's answer into a task graph with named objects, without what the sentence does not mention."""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from gausslite.domain.errors import TaskError
from gausslite.domain.task import (
    EXAMPLE,
    LIMITS,
    ObjectAttributes,
    Relation,
    TargetRole,
    TaskGraph,
    require_graph,
    require_task_text,
)
from gausslite.nouns import same_kind
from gausslite_language import lexicon
from gausslite_language.chunk import noun_phrase
from gausslite_language.chunker import chunk_tagged
from gausslite_language.graph_builder import build_draft
from gausslite_language.graph_draft import GraphDraft
from gausslite_language.lexicon import DescribedNoun, singular, split_attributes, word_set
from gausslite_language.nouns import are_one_kind
from gausslite_language.tags import tag_words
from gausslite_language.tokens import lexical_units, tokenize


@dataclass(frozen=True, slots=True)
class NamedObjects:
    """The name of each phrase of a sentence, the attributes of the names, and warnings."""

    names: dict[str, str]
    attributes: tuple[ObjectAttributes, ...]
    warnings: tuple[str, ...]


def name_objects(phrases: Iterable[str], excluded: Iterable[str] = ()) -> NamedObjects:
    """Return names for the phrases in their order of mention.

    A phrase without attributes names the latest object of its noun. An excluded phrase always names a new object.
    """
    names: dict[str, str] = {}
    described: dict[str, DescribedNoun] = {}
    referable: dict[str, DescribedNoun] = {}  # in the order of mention
    warnings: list[str] = []
    excluded = set(excluded)
    for phrase in dict.fromkeys(phrases):
        noun = split_attributes(phrase)
        warnings += [f"{word!r} is not understood: every {noun.noun!r} is meant" for word in noun.unseen]
        known = None if phrase in excluded else _known_name(noun, referable)
        number = 1 + sum(description.noun == noun.noun for description in described.values())
        names[phrase] = known or (noun.noun if number == 1 else f"{noun.noun}_{number}")
        described.setdefault(names[phrase], noun)
        if phrase not in excluded:
            referable.setdefault(names[phrase], described[names[phrase]])
    attributes = (
        ObjectAttributes(name, description.colour, description.superlative) for name, description in described.items()
    )
    return NamedObjects(
        names,
        tuple(attribute for attribute in attributes if attribute.colour or attribute.superlative),
        tuple(warnings),
    )


def _known_name(noun: DescribedNoun, described: Mapping[str, DescribedNoun]) -> str | None:
    """Return the name of the object with this noun and these attributes; without attributes, the latest of its noun."""
    same_noun = [name for name, description in described.items() if description.noun == noun.noun]
    if noun.colour is None and noun.superlative is None:
        return same_noun[-1] if same_noun else None
    attributes = noun.colour, noun.superlative
    return next(
        (name for name in same_noun if (described[name].colour, described[name].superlative) == attributes), None
    )


_TASK_ID_HEX_DIGITS = 12


def normalise_text(text: str) -> str:
    """Return the text in lower case, with plain quotes, single spaces and no punctuation at the end."""
    plain = unicodedata.normalize("NFKC", text).translate({0x2018: "'", 0x2019: "'", 0x201C: '"', 0x201D: '"'})
    return " ".join(plain.casefold().split()).strip(" .!?;:,")


def task_id_of(text: str) -> str:
    """Return a short hash of the normalised text: equal on every machine and for every spelling of a task."""
    return hashlib.sha256(normalise_text(text).encode()).hexdigest()[:_TASK_ID_HEX_DIGITS]


# a generic noun in an answer is valid if the sentence has one of these words, and the reverse
_ANY_OBJECT = (
    lexicon.GENERIC
    | lexicon.PLACES
    | lexicon.ROOMS
    | {word for word, noun in lexicon.INDEFINITE_PRONOUNS.items() if noun == "object"}
    | word_set("this that these those it them one ones whatever everywhere")
)
# beside the nouns of one kind in the vocabulary
_SYNONYMS = tuple(map(word_set, ("trash garbage rubbish litter waste", "cupboard cabinet", "elevator lift", "bin can")))
_ARTICLES = word_set("a an the this that these those my your his her its our their some any all every each")


@dataclass(frozen=True, slots=True)
class ParsedPhrases:
    """A parser's answer as noun phrases of the sentence, with their colours and superlatives."""

    targets: Mapping[str, TargetRole]
    anchors: Sequence[str] = ()
    relations: Sequence[Relation] = ()
    excluded: Sequence[str] = ()
    context: Sequence[str] = ()
    warnings: Sequence[str] = ()
    mentions: Sequence[str] = ()


def grounded_graph(text: str, parsed: ParsedPhrases, draft: GraphDraft | None = None) -> TaskGraph:
    """Return the validated graph of any parser's answer.

    Articles and plurals are removed, attributes are separated from the names. Dropped, with a warning: phrases whose
    head noun the sentence does not mention, targets that the sentence excludes, and relations between unlisted nouns.
    The rule parser passes its own `draft`; without one, the sentence is parsed by rules here. Raises TaskError if the
    text is not a task, if no target is left, or if the graph exceeds the limits.
    """
    require_task_text(text)
    mentioned, all_warnings = _sentence_words(text), list(parsed.warnings)
    if draft is None:
        draft = build_draft(chunk_tagged(tag_words(lexical_units(normalise_text(text)))))
        parsed = _with_rule_negations(parsed, draft, all_warnings.append)
    warn = all_warnings.append
    targets = _without_excluded(draft, _mentioned_phrases("target", tuple(parsed.targets), mentioned, warn), warn)
    anchors = _mentioned_phrases("anchor", parsed.anchors, mentioned, warn)
    excluded = _mentioned_phrases("excluded object", parsed.excluded, mentioned, warn)
    excluded = _without_used(excluded, (*targets, *anchors), warn)
    if not targets:
        shown = " ".join(text.split())[:60]
        raise TaskError(
            f"task targets: expected at least one object of the sentence, such as in {EXAMPLE}, got {shown!r}"
        )
    roles = {plain_phrase(phrase): role for phrase, role in parsed.targets.items()}
    graph = _named_graph(
        replace(
            parsed,
            targets={target: roles[target] for target in targets},
            anchors=anchors,
            relations=_valid_relations(parsed.relations, targets, anchors, warn),
            excluded=excluded,
            context=_mentioned_phrases("place", parsed.context, mentioned, warn)[: LIMITS.max_anchors],
            warnings=all_warnings,
        ),
        text,
    )
    require_graph(graph)
    return graph


def _named_graph(parsed: ParsedPhrases, text: str) -> TaskGraph:
    """Return the graph of normalised phrases, with one name for each object."""
    order = [plain_phrase(mention) for mention in parsed.mentions]
    kept = (*parsed.targets, *parsed.anchors, *parsed.excluded)
    named = name_objects([*(phrase for phrase in order if phrase in kept), *kept], parsed.excluded)
    names = named.names
    roles: dict[str, TargetRole] = {}
    for target, role in parsed.targets.items():
        roles.setdefault(names[target], role)
    relations = (
        replace(relation, target=names[relation.target], anchor=names[relation.anchor]) for relation in parsed.relations
    )
    return TaskGraph(
        task_id=task_id_of(text),
        text=text.strip(),
        targets=tuple(roles),
        anchors=_renamed(parsed.anchors, names),
        relations=tuple(dict.fromkeys(relations)),
        warnings=tuple((*parsed.warnings, *named.warnings)[: LIMITS.max_warnings]),
        roles=tuple(roles.values()),
        attributes=named.attributes,
        excluded=_renamed(parsed.excluded, names),
        context=tuple(parsed.context),
    )


def _with_rule_negations(parsed: ParsedPhrases, draft: GraphDraft, warn: Callable[[str], None]) -> ParsedPhrases:
    """Return a model's answer with the obstacles and the negations that the rules find in the same sentence."""
    negations = {
        (relation.predicate, relation.target, relation.anchor): relation.negated for relation in draft.relations
    }
    relations = []
    for relation in parsed.relations:
        key = relation.predicate, plain_phrase(relation.target), plain_phrase(relation.anchor)
        corrected = replace(relation, negated=negations.get(key, relation.negated))
        if corrected != relation:
            warn(f"{relation} contradicts the sentence: read as {corrected}")
        relations.append(corrected)
    obstacles = {phrase for phrase, role in draft.roles.items() if role is TargetRole.OBSTACLE}
    targets = {
        phrase: TargetRole.OBSTACLE if plain_phrase(phrase) in obstacles else role
        for phrase, role in parsed.targets.items()
    }
    return replace(parsed, targets=targets, relations=relations)


def _renamed(phrases: Sequence[str], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names[phrase] for phrase in phrases))


def _mentioned_phrases(
    role: str, phrases: Sequence[str], mentioned: frozenset[str], warn: Callable[[str], None]
) -> tuple[str, ...]:
    """Return the normalised phrases whose head noun the sentence mentions, without duplicates."""
    kept: dict[str, None] = {}
    for phrase in phrases:
        noun = plain_phrase(phrase)
        if _is_mentioned(noun, mentioned):
            kept[noun] = None
        else:
            warn(f"{role} {_abbreviate(phrase)} is not in the sentence: it is dropped")
    return tuple(kept)


def _without_excluded(draft: GraphDraft, targets: tuple[str, ...], warn: Callable[[str], None]) -> tuple[str, ...]:
    """Return the targets that the rules do not exclude; "mug" stays if only "the blue mug" is excluded."""
    kept: list[str] = []
    for target in targets:
        is_excluded = any(_may_be_same_object(target, phrase) for phrase in draft.excluded)
        if is_excluded and not any(_may_be_same_object(target, other) for other in draft.targets):
            warn(f"target {_abbreviate(target)} is to be left alone: it is dropped")
        else:
            kept.append(target)
    return tuple(kept)


def _may_be_same_object(one: str, other: str) -> bool:
    """Return True if the phrases are equal, or one is the other with more words before it."""
    return f" {one}".endswith(f" {other}") or f" {other}".endswith(f" {one}")


def _without_used(excluded: tuple[str, ...], used: tuple[str, ...], warn: Callable[[str], None]) -> tuple[str, ...]:
    """Return the excluded objects that are neither targets nor anchors."""
    for phrase in excluded:
        if phrase in used:
            warn(f"{_abbreviate(phrase)} is excluded and also a target or an anchor: its exclusion is dropped")
    return tuple(phrase for phrase in excluded if phrase not in used)


def plain_phrase(phrase: str) -> str:
    """Return a noun phrase for a detector: lower case, no article, the head in the singular, nothing after "of"."""
    tokens = normalise_text(phrase).split(" of ")[0].split()
    while len(tokens) > 1 and tokens[0] in _ARTICLES:
        tokens = tokens[1:]
    return noun_phrase(tokens, False).text if tokens else ""


def _valid_relations(
    relations: Sequence[Relation], targets: tuple[str, ...], anchors: tuple[str, ...], warn: Callable[[str], None]
) -> tuple[Relation, ...]:
    kept: dict[Relation, None] = {}
    for stated in relations:
        relation = replace(stated, target=plain_phrase(stated.target), anchor=plain_phrase(stated.anchor))
        if relation.target in targets and relation.anchor in anchors:
            kept[relation] = None
        else:
            nouns = f"{_abbreviate(stated.target)} to {_abbreviate(stated.anchor)}"
            warn(f"{stated.predicate} joins {nouns}, not both known: it is dropped")
    return tuple(kept)


def _abbreviate(phrase: str) -> str:
    return repr(phrase[: LIMITS.max_phrase_chars])


def _sentence_words(text: str) -> frozenset[str]:
    """Return every word of a sentence, also in the singular, and the parts of hyphenated words."""
    tokens = tokenize(normalise_text(text).replace("-", " ")) + normalise_text(text).split()
    bare = {token.strip(".,;:!?()\"'").removesuffix("'s") for token in tokens} - {""}
    glasses = {"glass"} if "glasses" in bare else set()  # of water, unlike spectacles
    return frozenset((*bare, *map(singular, bare), *tokens, *glasses))


def _is_mentioned(phrase: str, mentioned: frozenset[str]) -> bool:
    head = phrase.split()[-1] if phrase else ""
    if not head:
        return False
    if head in mentioned or head.split("-")[-1] in mentioned:
        return True
    if head in lexicon.GENERIC:
        return bool(mentioned & _ANY_OBJECT) or any(lexicon.is_space((word,)) for word in mentioned)
    if head == "person":
        return bool(mentioned & lexicon.PEOPLE)
    if any(head in group and mentioned & group for group in _SYNONYMS):
        return True
    return any(are_one_kind(head, word) or same_kind(head, word) for word in mentioned)
