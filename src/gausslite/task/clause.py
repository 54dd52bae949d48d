"""The state of one clause while its chunks are processed, and the test whether a noun names an object."""

from __future__ import annotations

from gausslite.task import lexicon
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.graph_draft import RelationTerms
from gausslite.task.noun_phrase import NounPhrase, adjectives_only
from gausslite.task.verbs import HANDLING_VERBS


class Clause:
    """The objects a verb acts on, the candidates for "it" (referents), and places still without an object.

    places: the destinations or tools named last, which further places describe. terms: of the latest preposition.
    superlative: "nearest" or "farthest" before the latest object. conjoined: the latest object followed
    a conjunction. by_pronoun: the objects come from "it" or "them". adds_place: the preposition follows a conjunction.
    route: the clause mentions a path. skip_of_phrase: the next "of" continues a noun that names no object.
    """

    def __init__(self, verb: str | None = None, referents: list[str] | None = None) -> None:
        self.verb = verb
        self.referents = referents or []
        self.objects: list[str] = []
        self.pending_places: list[tuple[RelationTerms, NounPhrase]] = []
        self.last_relation: str | None = None
        self.terms = RelationTerms("near")
        self.places: list[str] = []
        self.superlative: str | None = None
        self.statement = False
        self.conjoined = False
        self.is_part = False
        self.between = False
        self.in_space = False
        self.preposition = ""
        self.adds_place = False
        self.current_place = False
        self.by_pronoun = False
        self.follows_statement = False
        self.route = False
        self.skip_of_phrase = False
        self.inherited_conjoined = False
        self.inherited_preposition: str | None = None
        self.nouns_since_negation = 0
        self.verb_since_negation = False


def names_object(noun: NounPhrase, pending: str | None, after: Chunk | None, verb: str | None) -> bool:
    """Return False for names of the robot, and for places, routes and measures that stand for another noun."""
    if len(noun.words) == 1 and noun.head in lexicon.ADDRESSEES:
        return False
    if noun.head in lexicon.TASK_NOUNS and pending is None:
        return False
    of_follows = after is not None and after.kind is ChunkKind.PREPOSITION and after.word == "of"
    compound = len(noun.words) > 1 and not adjectives_only(noun.words[:-1])
    if compound and noun.head in lexicon.PLACES and not of_follows:
        return True
    if noun.head in lexicon.PHYSICAL_MEASURES and verb in HANDLING_VERBS and pending is None and not of_follows:
        return True
    unlikely = lexicon.TIME_NOUNS if noun.has_determiner else lexicon.MANNER_NOUNS | lexicon.TIME_NOUNS
    if noun.head in unlikely and adjectives_only(noun.words[:-1]) and pending not in (None, "from", "of", "to", "on"):
        return False
    if noun.head in lexicon.BUILDINGS:
        return pending != "inside" or bool(noun.words[1:])
    if noun.head in lexicon.PLACES:
        return noun.head in lexicon.PHYSICAL_PLACES and pending not in (None, "inside", "to") and not of_follows
    if noun.head in lexicon.ROUTES and not compound:
        return pending not in (None, "of", "for", "to")
    if noun.head in lexicon.MEASURES and pending not in (None, "of"):
        return not of_follows
    return noun.head not in lexicon.MEASURES or ((noun.is_known or compound) and not of_follows)


def with_shared_head(adjective: NounPhrase, noun: NounPhrase) -> NounPhrase:
    """Return the adjective with the noun's head: in "red and blue mugs", "red" becomes "red mug"."""
    words = adjective.words[:-1] if adjective.head in ("one", "ones") else adjective.words
    return NounPhrase((*words, noun.head), adjective.has_determiner)
