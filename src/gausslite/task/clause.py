"""What one verb of a sentence has gathered so far, and which of its nouns name an object at all."""

from __future__ import annotations

from gausslite.task import lexicon
from gausslite.task.phrases import NounPhrase, adjectives_only
from gausslite.task.pieces import Piece, TokenKind


class Clause:
    """The objects a verb acts on (subjects), what "it" would mean (referents), and places that wait for an object."""

    def __init__(self, verb: str | None = None, referents: list[str] | None = None) -> None:
        self.verb = verb
        self.referents = referents or []
        self.subjects: list[str] = []
        self.orphans: list[tuple[str, NounPhrase]] = []
        self.last_relation: str | None = None
        self.superlative = False
        self.aside = False
        self.joined = False
        self.part = False
        self.between = False
        self.stated = False
        self.by_reference = False
        self.mentioned = False
        self.route = False
        self.skip_of = False
        self.handed_joined = False
        self.handed_on: str | None = None
        self.nouns_since_negation = 0
        self.verb_since_negation = False


def names_object(noun: NounPhrase, pending: str | None, after: Piece | None) -> bool:
    """False for the robot itself, and for places, routes and measures that stand for something else."""
    if len(noun.words) == 1 and noun.head in lexicon.SELVES:
        return False
    if noun.head in lexicon.TASK_WORDS and pending is None:
        return False
    leads_on = after is not None and after.kind is TokenKind.PREPOSITION and after.word == "of"
    compound = len(noun.words) > 1 and not adjectives_only(noun.words[:-1])
    if compound and noun.head in lexicon.PLACES and not leads_on:
        return True
    unlikely = lexicon.TIMES if noun.determined else lexicon.MANNERS | lexicon.TIMES
    if noun.head in unlikely and adjectives_only(noun.words[:-1]) and pending not in (None, "from", "of", "to", "on"):
        return False
    if noun.head in lexicon.BUILDINGS:
        return pending != "inside" or bool(noun.words[1:])
    if noun.head in lexicon.PLACES:
        return noun.head in lexicon.SOLID_PLACES and pending not in (None, "inside", "to") and not leads_on
    if noun.head in lexicon.ROUTES:
        return pending not in (None, "of", "for", "to")
    if noun.head in lexicon.MEASURES and pending not in (None, "of"):
        return not leads_on
    return noun.head not in lexicon.MEASURES or ((noun.known or compound) and not leads_on)


def described(adjective: NounPhrase, noun: NounPhrase) -> NounPhrase:
    """In "red and blue mugs", red takes the head that it shares."""
    words = adjective.words[:-1] if adjective.head in ("one", "ones") else adjective.words
    return NounPhrase((*words, noun.head), adjective.determined, noun.superlative)
