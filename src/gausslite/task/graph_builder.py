"""Decide what each noun of a sentence is to the task: target, anchor, or none of its business."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gausslite.task import lexicon
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.clause import Clause, names_object, with_shared_head
from gausslite.task.graph_draft import GraphDraft
from gausslite.task.noun_phrase import NounPhrase, adjectives_only, phrase_from_text
from gausslite.task.role_assignment import RoleAssigner
from gausslite.task.verbs import BELONGING_VERBS

# "drone, fly to the roof" speaks to it, "find the drone" does not
_ADDRESSED_ROBOTS = (("drone",), ("rover",))


def build_draft(chunks: Sequence[Chunk]) -> GraphDraft:
    """The draft of a whole sentence."""
    builder = GraphBuilder()
    for at, chunk in enumerate(chunks):
        builder.add(chunks[at - 1] if at else None, chunk, chunks[at + 1 :])
    return builder.finish()


class GraphBuilder:
    """Takes the chunks of one sentence in order and hands out the draft of its graph."""

    def __init__(self) -> None:
        self._draft = GraphDraft()
        self._assigner = RoleAssigner(self._draft)
        self._pending: str | None = None
        self._also: str | None = None  # in "under or behind the couch", under
        self._negated = False
        self._corrects = False
        self._adjectives: list[NounPhrase] = []
        self._following: Sequence[Chunk] = ()

    def add(self, before: Chunk | None, chunk: Chunk, following: Sequence[Chunk]) -> None:
        """Read one chunk, knowing the one before it and all that follow."""
        after, self._following = (following[0] if following else None), following
        if chunk.kind is ChunkKind.VERB:
            self._verb(before, chunk)
        elif chunk.kind is ChunkKind.SUBJECT_VERB:
            self._clause.verb = "put" if chunk.word in BELONGING_VERBS else chunk.word
            self._clause.last_relation, self._negated = None, False
        elif chunk.kind is ChunkKind.NOUN and chunk.noun is not None:
            self._noun(before, chunk.noun, after)
        elif chunk.kind is ChunkKind.PREPOSITION:
            # "all but the lighter, to the tent": the exception is over
            self._negated = self._negated and (
                before is None or before.kind is not ChunkKind.CONJUNCTION or before.word == "or"
            )
            self._also = self._pending if before is not None and before.kind is ChunkKind.CONJUNCTION else None
            self._pending, self._clause.current_place = chunk.word, chunk.current_place
        elif chunk.kind is ChunkKind.NEGATION:
            self._negation(chunk.word)
        elif chunk.kind in (ChunkKind.CLAUSE_BREAK, ChunkKind.STATEMENT):
            self._new_clause(None)
            self._negated, self._clause.statement = False, chunk.kind is ChunkKind.STATEMENT
        elif chunk.kind is ChunkKind.ANAPHOR:
            self._back_reference(chunk.word, before)
        elif chunk.kind is ChunkKind.DEMONSTRATIVE:
            self._pointing(chunk.word, before, after)

    def finish(self) -> GraphDraft:
        """Close the last clause; the draft without what the sentence says to leave alone."""
        self._new_clause(None)
        self._draft.finalise()
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

    def _leave_excludes(self) -> bool:
        """In "take the cups and leave the plates" nothing says where the plates would be left."""
        rest = [chunk.kind for chunk in self._following if chunk.kind not in (ChunkKind.NOUN, ChunkKind.CONJUNCTION)]
        named = bool(self._following) and self._following[0].kind is ChunkKind.NOUN
        return named and (not rest or rest[0] in (ChunkKind.CLAUSE_BREAK, ChunkKind.VERB))

    def _verb(self, before: Chunk | None, chunk: Chunk) -> None:
        if chunk.word == "leave" and self._draft.targets and self._leave_excludes():
            self._negate()
            return
        same_negation = self._negated and (
            self._clause.nouns_since_negation == 0
            or chunk.gerund
            or (before is not None and before.kind is ChunkKind.CONJUNCTION and before.word == "or")
        )
        if not same_negation:
            self._negated = False
        self._pending, self._adjectives = None, []
        self._clause.verb_since_negation = True
        spoken_for = self._clause.objects or (self._clause.pending_places and self._clause.verb)
        if not same_negation and spoken_for:
            self._new_clause(chunk.word)
        else:
            self._clause.verb = chunk.word

    def _new_clause(self, verb: str | None) -> None:
        self._assigner.end_clause(verb)
        self._pending = None

    @property
    def _clause(self) -> Clause:
        return self._assigner.clause

    def _back_reference(self, word: str, before: Chunk | None) -> None:
        """The words "it" and "them" are the clause's objects, or behind a preposition what was named before these."""
        clause = self._clause
        if not clause.referents and not clause.objects and before is not None and before.kind is ChunkKind.VERB:
            self._pointing(word, before, None)
            return
        pending, self._pending = self._pending, None
        if self._negated:
            return
        if pending is None:
            clause.objects = clause.objects or list(clause.referents)
            if not clause.statement:
                clause.by_pronoun = bool(clause.verb and clause.objects)
                self._draft.confirm_targets(clause.objects)
            return
        named, subjects = (clause.objects[:-1], clause.objects[-1:]) if clause.conjoined else (
            clause.referents or self._draft.targets[-2:-1], clause.objects
        )  # fmt: skip
        if named and subjects:
            clause.objects = subjects
            for each in named:
                self._assigner.assign_by_preposition(pending, phrase_from_text(each))

    def _pointing(self, word: str, before: Chunk | None, after: Chunk | None) -> None:
        """A "this" that points at something without naming it."""
        if self._negated or (self._clause.verb is None and self._pending is None):
            return
        self._draft.unnamed = self._draft.unnamed or word
        if self._pending is None:
            self._noun(before, phrase_from_text("object"), after)
        self._pending = None

    def _noun(self, before: Chunk | None, noun: NounPhrase, after: Chunk | None) -> None:
        if noun.words in _ADDRESSED_ROBOTS and not (noun.has_determiner or self._clause.verb or self._pending):
            return
        joined = before is not None and before.kind is ChunkKind.CONJUNCTION
        if joined and self._corrects and self._clause.nouns_since_negation:
            self._negated = False  # "not the wooden spoon, the metal one"
        if noun.head in ("one", "ones"):
            if self._negated and len(noun.words) == 1:
                return  # "this mug, not that one"
            noun = self._resolve_one(noun)
        pending, self._pending = self._pending, None
        leads_on = after is not None and after.kind is ChunkKind.PREPOSITION and after.word == "of"
        if adjectives_only(noun.words) and not (leads_on and noun.head in lexicon.PLACES):
            if after is not None and after.kind is ChunkKind.CONJUNCTION:
                self._adjectives.append(noun)
            return
        if not names_object(noun, pending, after):
            self._skip_noun(noun, pending, joined, after)
            return
        nouns = [*(with_shared_head(adjective, noun) for adjective in self._adjectives), noun]
        self._adjectives = []
        for each in nouns:
            if self._negated:
                self._exclude(each, pending)
            else:
                self._assigner.assign(each, pending, joined, self._following)
                if self._also is not None:
                    self._assigner.assign_by_preposition(self._also, each)
        self._also = None

    def _resolve_one(self, one: NounPhrase) -> NounPhrase:
        """In "the blue one" the noun is the one that the task is about."""
        named = (
            self._clause.objects or self._clause.referents or self._draft.targets or self._draft.excluded or ["object"]
        )
        same = phrase_from_text(named[-1])
        return with_shared_head(one, same) if len(one.words) > 1 else replace(same, superlative=one.superlative)

    def _skip_noun(self, noun: NounPhrase, pending: str | None, joined: bool, after: Chunk | None) -> None:
        """The edge of the table hands its preposition on to the table; a path to the door makes the door a goal."""
        if noun.head in lexicon.ROUTES:
            self._clause.route = True
        elif noun.head in lexicon.PLACES and pending is None:
            self._draft.whole_place = noun.text
        leads_on = after is not None and after.kind is ChunkKind.PREPOSITION and after.word == "of"
        self._clause.inherited_preposition = pending if leads_on else None
        self._clause.skip_of_phrase, self._clause.inherited_conjoined = leads_on, joined

    def _exclude(self, noun: NounPhrase, pending: str | None) -> None:
        clause = self._clause
        direct = pending is None or (clause.nouns_since_negation == 0 and clause.verb_since_negation)
        if not direct and clause.nouns_since_negation == 0:
            self._draft.warnings.append(f"an exception by place ({noun.text!r}) is not supported: it is dropped")
        clause.nouns_since_negation += 1
        if direct and noun.text not in self._draft.excluded:
            self._draft.excluded.append(noun.text)
