"""Decide what each noun of a sentence is to the task: target, anchor, or none of its business."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gausslite.task import lexicon
from gausslite.task.clause import Clause, described, names_object
from gausslite.task.draft import GraphDraft
from gausslite.task.phrases import NounPhrase, adjectives_only, known_phrase
from gausslite.task.pieces import Piece, TokenKind
from gausslite.task.placing import NounPlacer
from gausslite.task.verbs import BELONGING_VERBS

# "drone, fly to the roof" speaks to it, "find the drone" does not
_ADDRESSED = (("drone",), ("rover",))


def draft_of(pieces: Sequence[Piece]) -> GraphDraft:
    """The draft of a whole sentence."""
    builder = GraphBuilder()
    for at, piece in enumerate(pieces):
        builder.add(pieces[at - 1] if at else None, piece, pieces[at + 1 :])
    return builder.finish()


class GraphBuilder:
    """Takes the pieces of one sentence in order and hands out the draft of its graph."""

    def __init__(self) -> None:
        self._draft = GraphDraft()
        self._placer = NounPlacer(self._draft)
        self._pending: str | None = None
        self._also: str | None = None  # in "under or behind the couch", under
        self._negated = False
        self._corrects = False
        self._adjectives: list[NounPhrase] = []
        self._following: Sequence[Piece] = ()

    def add(self, before: Piece | None, piece: Piece, following: Sequence[Piece]) -> None:
        """Read one piece, knowing the one before it and all that follow."""
        after, self._following = (following[0] if following else None), following
        if piece.kind is TokenKind.VERB:
            self._verb(before, piece)
        elif piece.kind is TokenKind.BELONGS:
            self._clause.verb = "put" if piece.word in BELONGING_VERBS else piece.word
            self._clause.last_relation, self._negated = None, False
        elif piece.kind is TokenKind.NOUN and piece.noun is not None:
            self._noun(before, piece.noun, after)
        elif piece.kind is TokenKind.PREPOSITION:
            # "all but the lighter, to the tent": the exception is over
            self._negated = self._negated and (
                before is None or before.kind is not TokenKind.JOIN or before.word == "or"
            )
            self._also = self._pending if before is not None and before.kind is TokenKind.JOIN else None
            self._pending, self._clause.stated = piece.word, piece.stated
        elif piece.kind is TokenKind.NEGATION:
            self._negation(piece.word)
        elif piece.kind in (TokenKind.BREAK, TokenKind.ASIDE):
            self._new_clause(None)
            self._negated, self._clause.aside = False, piece.kind is TokenKind.ASIDE
        elif piece.kind is TokenKind.BACK_REFERENCE:
            self._back_reference(piece.word, before)
        elif piece.kind is TokenKind.POINTING:
            self._pointing(piece.word, before, after)

    def finish(self) -> GraphDraft:
        """Close the last clause; the draft without what the sentence says to leave alone."""
        self._new_clause(None)
        self._draft.settle()
        return self._draft

    def _negation(self, word: str) -> None:
        """Two of them cancel out: "ignore everything except the signs" asks for the signs."""
        if self._negated and self._draft.excluded[-1:] == ["object"]:
            self._draft.excluded.pop()
            self._negated = False
            return
        self._corrects = word == "not" and not self._draft.targets
        self._negate()

    def _negate(self) -> None:
        self._pending, self._negated = None, True
        self._clause.nouns_since_negation = 0
        self._clause.verb_since_negation = False

    def _leaves_alone(self) -> bool:
        """In "take the cups and leave the plates" nothing says where the plates would be left."""
        rest = [piece.kind for piece in self._following if piece.kind not in (TokenKind.NOUN, TokenKind.JOIN)]
        named = bool(self._following) and self._following[0].kind is TokenKind.NOUN
        return named and (not rest or rest[0] in (TokenKind.BREAK, TokenKind.VERB))

    def _verb(self, before: Piece | None, piece: Piece) -> None:
        if piece.word == "leave" and self._draft.targets and self._leaves_alone():
            self._negate()
            return
        same_negation = self._negated and (
            self._clause.nouns_since_negation == 0
            or piece.gerund
            or (before is not None and before.kind is TokenKind.JOIN and before.word == "or")
        )
        if not same_negation:
            self._negated = False
        self._pending, self._adjectives = None, []
        self._clause.verb_since_negation = True
        spoken_for = self._clause.subjects or (self._clause.orphans and self._clause.verb)
        if not same_negation and spoken_for:
            self._new_clause(piece.word)
        else:
            self._clause.verb = piece.word

    def _new_clause(self, verb: str | None) -> None:
        self._placer.end_clause(verb)
        self._pending = None

    @property
    def _clause(self) -> Clause:
        return self._placer.clause

    def _back_reference(self, word: str, before: Piece | None) -> None:
        """The words "it" and "them" are the clause's objects, or behind a preposition what was named before these."""
        clause = self._clause
        if not clause.referents and not clause.subjects and before is not None and before.kind is TokenKind.VERB:
            self._pointing(word, before, None)
            return
        pending, self._pending = self._pending, None
        if self._negated:
            return
        if pending is None:
            clause.subjects = clause.subjects or list(clause.referents)
            if not clause.aside:
                clause.by_reference = bool(clause.verb and clause.subjects)
                self._draft.mean(clause.subjects)
            return
        named, subjects = (clause.subjects[:-1], clause.subjects[-1:]) if clause.joined else (
            clause.referents or self._draft.targets[-2:-1], clause.subjects
        )  # fmt: skip
        if named and subjects:
            clause.subjects = subjects
            for each in named:
                self._placer.by_preposition(pending, known_phrase(each))

    def _pointing(self, word: str, before: Piece | None, after: Piece | None) -> None:
        """A "this" that points at something without naming it."""
        if self._negated or (self._clause.verb is None and self._pending is None):
            return
        self._draft.unnamed = self._draft.unnamed or word
        if self._pending is None:
            self._noun(before, known_phrase("object"), after)
        self._pending = None

    def _noun(self, before: Piece | None, noun: NounPhrase, after: Piece | None) -> None:
        if noun.words in _ADDRESSED and not (noun.determined or self._clause.verb or self._pending):
            return
        joined = before is not None and before.kind is TokenKind.JOIN
        if joined and self._corrects and self._clause.nouns_since_negation:
            self._negated = False  # "not the wooden spoon, the metal one"
        if noun.head in ("one", "ones"):
            if self._negated and len(noun.words) == 1:
                return  # "this mug, not that one"
            noun = self._another(noun)
        pending, self._pending = self._pending, None
        leads_on = after is not None and after.kind is TokenKind.PREPOSITION and after.word == "of"
        if adjectives_only(noun.words) and not (leads_on and noun.head in lexicon.PLACES):
            if after is not None and after.kind is TokenKind.JOIN:
                self._adjectives.append(noun)
            return
        if not names_object(noun, pending, after):
            self._dropped(noun, pending, joined, after)
            return
        nouns = [*(described(adjective, noun) for adjective in self._adjectives), noun]
        self._adjectives = []
        for each in nouns:
            if self._negated:
                self._exclude(each, pending)
            else:
                self._placer.place(each, pending, joined, self._following)
                if self._also is not None:
                    self._placer.by_preposition(self._also, each)
        self._also = None

    def _another(self, one: NounPhrase) -> NounPhrase:
        """In "the blue one" the noun is the one that the task is about."""
        named = (
            self._clause.subjects or self._clause.referents or self._draft.targets or self._draft.excluded or ["object"]
        )
        same = known_phrase(named[-1])
        return described(one, same) if len(one.words) > 1 else replace(same, superlative=one.superlative)

    def _dropped(self, noun: NounPhrase, pending: str | None, joined: bool, after: Piece | None) -> None:
        """The edge of the table hands its preposition on to the table; a path to the door makes the door a goal."""
        if noun.head in lexicon.ROUTES:
            self._clause.route = True
        elif noun.head in lexicon.PLACES and pending is None:
            self._draft.whole_place = noun.text
        leads_on = after is not None and after.kind is TokenKind.PREPOSITION and after.word == "of"
        self._clause.handed_on = pending if leads_on else None
        self._clause.skip_of, self._clause.handed_joined = leads_on, joined

    def _exclude(self, noun: NounPhrase, pending: str | None) -> None:
        clause = self._clause
        direct = pending is None or (clause.nouns_since_negation == 0 and clause.verb_since_negation)
        if not direct and clause.nouns_since_negation == 0:
            self._draft.warnings.append(f"an exception by place ({noun.text!r}) is not supported: it is dropped")
        clause.nouns_since_negation += 1
        if direct and noun.text not in self._draft.excluded:
            self._draft.excluded.append(noun.text)
