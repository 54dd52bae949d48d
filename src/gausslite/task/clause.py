"""What one verb of a sentence has gathered so far, and which of its nouns name an object at all."""

from __future__ import annotations

from gausslite.task import lexicon
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.noun_phrase import NounPhrase, adjectives_only


class Clause:
    """The objects a verb acts on (subjects), what "it" would mean (referents), and places that wait for an object."""

    def __init__(self, verb: str | None = None, referents: list[str] | None = None) -> None:
        self.verb = verb
        self.referents = referents or []
        self.objects: list[str] = []
        self.pending_places: list[tuple[str, NounPhrase]] = []
        self.last_relation: str | None = None
        self.superlative = False
        self.statement = False
        self.conjoined = False
        self.is_part = False
        self.between = False
        self.current_place = False
        self.by_pronoun = False
        self.follows_statement = False
        self.route = False
        self.skip_of_phrase = False
        self.inherited_conjoined = False
        self.inherited_preposition: str | None = None
        self.nouns_since_negation = 0
        self.verb_since_negation = False


def names_object(noun: NounPhrase, pending: str | None, after: Chunk | None) -> bool:
    """False for the robot itself, and for places, routes and measures that stand for something else."""
    if len(noun.words) == 1 and noun.head in lexicon.ADDRESSEES:
        return False
    if noun.head in lexicon.TASK_NOUNS and pending is None:
        return False
    leads_on = after is not None and after.kind is ChunkKind.PREPOSITION and after.word == "of"
    compound = len(noun.words) > 1 and not adjectives_only(noun.words[:-1])
    if compound and noun.head in lexicon.PLACES and not leads_on:
        return True
    unlikely = lexicon.TIME_NOUNS if noun.has_determiner else lexicon.MANNER_NOUNS | lexicon.TIME_NOUNS
    if noun.head in unlikely and adjectives_only(noun.words[:-1]) and pending not in (None, "from", "of", "to", "on"):
        return False
    if noun.head in lexicon.BUILDINGS:
        return pending != "inside" or bool(noun.words[1:])
    if noun.head in lexicon.PLACES:
        return noun.head in lexicon.PHYSICAL_PLACES and pending not in (None, "inside", "to") and not leads_on
    if noun.head in lexicon.ROUTES:
        return pending not in (None, "of", "for", "to")
    if noun.head in lexicon.MEASURES and pending not in (None, "of"):
        return not leads_on
    return noun.head not in lexicon.MEASURES or ((noun.is_known or compound) and not leads_on)


def with_shared_head(adjective: NounPhrase, noun: NounPhrase) -> NounPhrase:
    """In "red and blue mugs", red takes the head that it shares."""
    words = adjective.words[:-1] if adjective.head in ("one", "ones") else adjective.words
    return NounPhrase((*words, noun.head), adjective.has_determiner, noun.superlative)
