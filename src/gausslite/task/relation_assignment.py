"""Relate the objects, destinations and tools of a clause to the nouns that locate them."""

from __future__ import annotations

from gausslite.domain.task import Predicate, Superlative
from gausslite.task import lexicon
from gausslite.task.attributes import SUPERLATIVES
from gausslite.task.clause import Clause
from gausslite.task.graph_draft import GraphDraft, RelationTerms
from gausslite.task.noun_phrase import NounPhrase


class RelationAssigner:
    """Add the relations of the current clause to a draft."""

    def __init__(self, draft: GraphDraft) -> None:
        self._draft = draft
        self.clause = Clause()

    def relate(self, relation: str, noun: NounPhrase) -> None:
        """Relate the clause's objects to the noun; a place named before any object is kept for the next object."""
        self.relate_by(RelationTerms(relation, self.clause.terms.negated, self.clause.terms.bounds), noun)

    def relate_by(self, terms: RelationTerms, noun: NounPhrase) -> None:
        """Relate the clause's objects by complete terms, as `relate` does."""
        clause = self.clause
        clause.last_relation = terms.relation
        clause.in_space = self._is_context(terms, noun)
        if not clause.objects:
            clause.pending_places.append((terms, noun))
        elif clause.in_space:
            self._draft.add_context(noun.text)
        else:
            self._draft.add_relation(terms, clause.objects, noun.text)

    def relate_places(self, terms: RelationTerms, noun: NounPhrase) -> None:
        """Relate the destinations or tools named last: "put it on the table by the window"."""
        if self._is_context(terms, noun):
            self._draft.add_context(noun.text)
        else:
            self._draft.add_relation(terms, self.clause.places, noun.text)

    def _is_context(self, terms: RelationTerms, noun: NounPhrase) -> bool:
        is_context = terms.relation == "inside" and lexicon.is_space(noun.words)
        if is_context and terms.negated:
            self._draft.warnings.append(f"not in {noun.text!r}: a place is not evaluated, the exception is dropped")
        return is_context

    def is_extreme(self, pending: str) -> bool:
        """Return True for "the nearest chair to", "the farthest cone from"."""
        superlative = SUPERLATIVES.get(self.clause.superlative or "")
        is_farthest = superlative is Superlative.FARTHEST and pending == "from"
        return bool(self.clause.objects) and (is_farthest or (superlative is not None and pending == "to"))

    def relate_extreme(self, noun: NounPhrase) -> None:
        """Relate the clause's objects as the nearest or farthest to the noun."""
        clause = self.clause
        word = clause.superlative or ""
        for phrase in list(clause.objects):
            self.rename(phrase, " ".join(each for each in phrase.split() if each != word))
        farthest = SUPERLATIVES[word] is Superlative.FARTHEST
        clause.superlative = None
        self.relate(Predicate.FARTHEST_FROM if farthest else Predicate.CLOSEST_TO, noun)

    def rename(self, phrase: str, new: str) -> None:
        """Change the description of an object that the sentence has named."""
        self._draft.rename(phrase, new)
        for phrases in (self.clause.objects, self.clause.referents, self.clause.places):
            phrases[:] = [new if each == phrase else each for each in phrases]
