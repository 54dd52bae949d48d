"""Read a sentence as a row of verbs, noun phrases, prepositions and joints, without yet asking what they mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from gausslite.task import lexicon
from gausslite.task.clauses import NOMINATIVES, SUBJECTS, WISHES, Mood, commands, is_modal, moods_of
from gausslite.task.phrases import adjectives_only, noun_phrase
from gausslite.task.pieces import Piece, TokenKind
from gausslite.task.prepositions import PREPOSITIONS
from gausslite.task.tagging import tagged
from gausslite.task.tags import Tag
from gausslite.task.tokens import units_of
from gausslite.task.verb_forms import is_particle, verb_base
from gausslite.task.verbs import ASPECT_VERBS, BELONGING_VERBS, GO_VERBS, HOLDING_VERBS
from gausslite.task.words import words

_POINTING: Final = words("this that these those")
_SUPERLATIVES: Final = words("closest nearest")
_RELATIVES: Final = words("that which who whom")
# "go around the table to the sofa" passes the one and reaches the other
_WAYS: Final = words("near past above")
_HAVING: Final = words("has have had")
_DOING: Final = words("do does did")
_REFUSALS: Final = WISHES | words("care touch mean")
_IN_A_NOUN: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE})
# "the drawer open", "is empty"
_BEFORE_A_STATE: Final = frozenset({Tag.NOUN, Tag.STAND_IN, Tag.AUXILIARY})
_BEFORE_A_GERUND: Final = frozenset({Tag.NOUN, Tag.PREPOSITION, Tag.NEGATION, Tag.VERB, Tag.AUXILIARY})
_DESCRIBED: Final = frozenset({Tag.NOUN, Tag.PARTICIPLE})
# what stands before a place where something is, and not where it is to go
_STATES: Final = frozenset({Tag.AUXILIARY, Tag.RELATIVE, Tag.PARTICIPLE, Tag.ING})
# "that is not open" forbids nothing, "that is not a duck" does
_FORBIDDEN: Final = frozenset({Tag.VERB, Tag.DETERMINER, Tag.NOUN})
_OPENS_OBJECT: Final = frozenset({Tag.DETERMINER, Tag.NOUN, Tag.ADJECTIVE, Tag.STAND_IN})


def read(text: str) -> list[Piece]:
    """The pieces of one normalised sentence, in order."""
    return _Reader(tagged(units_of(text))).read()


class _Reader:
    """Walks the tagged words once, collecting the words of the noun phrase that is open."""

    def __init__(self, said: Sequence[tuple[str, Tag]]) -> None:
        self.said = said
        self.moods = moods_of(said)
        self.at = 0
        self.pieces: list[Piece] = []
        self.words: list[str] = []
        self.determined = False
        self.superlative = False
        self.modal = False
        self.subject_at = 0
        self.relative_from: int | None = None
        self._read: dict[Tag, Callable[[str], None]] = {
            Tag.NOUN: self._noun,
            Tag.ADJECTIVE: self._adjective,
            Tag.DETERMINER: self._determiner,
            Tag.VERB: self._verb,
            Tag.ING: self._ing,
            Tag.PARTICIPLE: self._participle,
            Tag.PREPOSITION: self._preposition,
            Tag.PARTICLE: self._particle,
            Tag.JOIN: lambda word: self._emit(TokenKind.JOIN, word),
            Tag.BREAK: self._break,
            Tag.STAND_IN: self._stand_in,
            Tag.AUXILIARY: self._auxiliary,
            Tag.RELATIVE: self._relative,
            Tag.PRONOUN: self._pronoun,
            Tag.BACK_REFERENCE: self._back_reference,
            Tag.NEGATION: self._negation,
        }

    def read(self) -> list[Piece]:
        mood = Mood.TASK
        for at, (word, tag) in enumerate(self.said):
            self.at = at
            before, mood = mood, self.moods.get(at, mood)
            if tag is Tag.JOIN and mood is Mood.TASK and (before is Mood.ASIDE or self._asks_anew(at)):
                tag = Tag.BREAK
            if mood is Mood.ASIDE and at in self.moods:
                self._emit(TokenKind.ASIDE, word)
                if tag in (Tag.BREAK, Tag.JOIN):
                    continue
            if mood is not Mood.REASON:
                self._read.get(tag, self._skip)(word)
        self._close()
        return self.pieces

    def _asks_anew(self, at: int) -> bool:
        """In "if it is no trouble, could you come" the question begins a sentence of its own."""
        return at in self.moods and self._tag(1) is Tag.AUXILIARY

    def _tag(self, ahead: int) -> Tag | None:
        position = self.at + ahead
        return self.said[position][1] if 0 <= position < len(self.said) else None

    def _word(self, ahead: int) -> str:
        position = self.at + ahead
        return self.said[position][0] if 0 <= position < len(self.said) else ""

    def _last(self) -> TokenKind | None:
        return self.pieces[-1].kind if self.pieces else None

    def _emit(self, kind: TokenKind, word: str, gerund: bool = False, stated: bool = False) -> None:
        self._close()
        self.pieces.append(Piece(kind, word, gerund=gerund, stated=stated))

    def _close(self) -> None:
        """End the open noun phrase."""
        if self.words:
            self.pieces.append(
                Piece(TokenKind.NOUN, self.words[-1], noun_phrase(self.words, self.determined, self.superlative))
            )
        self.words, self.determined, self.superlative = [], False, False

    def _skip(self, _word: str) -> None:
        self._close()

    def _noun(self, word: str) -> None:
        # "the red and blue mugs": an adjective on its own waits for the noun of the next phrase
        if not self.words and self._last() is TokenKind.JOIN and len(self.pieces) >= 2:
            before = self.pieces[-2].noun
            if before is not None and adjectives_only(before.words):
                self.determined = before.determined
        self.words.append(word)

    def _adjective(self, word: str) -> None:
        if word.endswith(("'s", "s'")):
            self._determiner(word)
            self.words = []
        elif word in _SUPERLATIVES:
            self.superlative = True
        elif self._tag(-1) in _BEFORE_A_STATE and self._tag(1) not in _IN_A_NOUN:
            self._close()
        else:
            self.words.append(word)

    def _determiner(self, word: str) -> None:
        if word.endswith(("'s", "s'")):
            self.words = []
        self._close()
        self.determined, self.subject_at = True, self.at

    def _stand_in(self, word: str) -> None:
        self._close()
        # "what does the sign say", "what is that thing"
        if word == "what" and (
            self._word(1) in _DOING or (self._tag(2) in _OPENS_OBJECT and self._tag(1) is Tag.AUXILIARY)
        ):
            return
        self.words.append(lexicon.STAND_INS.get(word, "person"))
        self._close()

    def _back_reference(self, word: str) -> None:
        self._emit(TokenKind.POINTING if word in _POINTING else TokenKind.BACK_REFERENCE, word)

    def _break(self, word: str) -> None:
        self._close()
        if word != "that":
            self._emit(TokenKind.BREAK, word)

    def _negation(self, word: str) -> None:
        if self._tag(-1) is Tag.PRONOUN and self._word(-1) != "you" and verb_base(self._word(1)) not in _REFUSALS:
            self._close()  # "I can't find my phone"
            return
        if self._tag(1) is Tag.AUXILIARY and self._tag(2) in (Tag.PARTICIPLE, Tag.VERB):
            self._forbid(word)
            return
        if self._tag(-1) is Tag.AUXILIARY and self._word(-1) != "do" and self._tag(1) not in _FORBIDDEN:
            self._close()
        else:
            self._emit(TokenKind.NEGATION, word)

    def _forbid(self, word: str) -> None:
        """In "the lamp and the vase must not be touched" what is excluded stands before."""
        self._close()
        at = len(self.pieces)
        while at and self.pieces[at - 1].kind in (TokenKind.NOUN, TokenKind.JOIN):
            at -= 1
        self.pieces.insert(at, Piece(TokenKind.NEGATION, word))

    def _pronoun(self, word: str) -> None:
        """In "ignore the cars, I only want the bikes" a new sentence begins."""
        self._close()
        if word in NOMINATIVES and self._last() is TokenKind.JOIN and self.at - 1 in self.moods:
            self._emit(TokenKind.BREAK, word)

    def _relative(self, word: str) -> None:
        self._close()
        if word in _RELATIVES and self._last() is TokenKind.NOUN:
            self.relative_from = len(self.pieces)

    def _end_relative_subject(self, finite: bool) -> None:
        """In "the mug that my wife uses" and "the mug my wife uses" the wife is none of the task's business."""
        self._close()
        adjacent = self.subject_at > 0 and self.said[self.subject_at - 1][1] is Tag.NOUN
        if finite and adjacent and [piece.kind for piece in self.pieces[-2:]] == [TokenKind.NOUN, TokenKind.NOUN]:
            self.pieces.pop()
        if self.relative_from is not None and self.relative_from == len(self.pieces) - 1:
            self.pieces.pop()
        self.relative_from = None

    def _auxiliary(self, word: str) -> None:
        self._end_relative_subject(finite=True)
        if word in _HAVING and self._last() is TokenKind.NOUN and self._tag(1) in _OPENS_OBJECT:
            self._emit(TokenKind.PREPOSITION, "near")
        self.modal = is_modal(self.said, self.at) and self._last() is TokenKind.NOUN

    def _verb(self, word: str) -> None:
        self._end_relative_subject(finite=True)
        base = verb_base(word) or word
        subject = self._tag(-1)
        self.modal, must = is_modal(self.said, self.at) and subject in SUBJECTS, self.modal
        if subject is Tag.INFINITIVE and self._tag(-2) is Tag.STAND_IN and self._tag(1) not in _OPENS_OBJECT:
            self._close()  # "something to write with"
        elif must and self._subject_is_thing():
            if base in BELONGING_VERBS:
                self._emit(TokenKind.BELONGS, base)
        elif subject not in SUBJECTS or commands(self.said, self.at) or (subject is Tag.PRONOUN and base in WISHES):
            self._emit(TokenKind.VERB, base)
        elif base in BELONGING_VERBS and subject is not Tag.PRONOUN:
            self._emit(TokenKind.BELONGS, base)
        elif subject in (Tag.NOUN, Tag.RELATIVE, Tag.STAND_IN) and self._tag(1) in _OPENS_OBJECT | {Tag.PRONOUN}:
            self._act(base)
        else:
            self._close()

    def _act(self, base: str) -> None:
        """The cans are near the shelf that holds them; who left a bag, and what a key opens, are not asked for."""
        if base in HOLDING_VERBS:
            self._emit(TokenKind.PREPOSITION, "near")
        elif self._tag(-1) is Tag.STAND_IN and self._last() is TokenKind.NOUN:
            self.pieces.pop()
        else:
            self._emit(TokenKind.PREPOSITION, "purpose")

    def _subject_is_thing(self) -> bool:
        noun = self.pieces[-1].noun if self.pieces else None
        return noun is not None and noun.head not in lexicon.SELVES

    def _ing(self, word: str) -> None:
        before, after = self._tag(-1), self._tag(1)
        opens = self.determined or before not in _BEFORE_A_GERUND
        opens = opens or (
            before is Tag.VERB and self._last() is TokenKind.VERB and self.pieces[-1].word not in ASPECT_VERBS
        )
        if opens and after in _IN_A_NOUN and lexicon.ADJECTIVES.issuperset(self.words):
            self.words.append(word)  # "the leaking pipe"
        elif before is Tag.PREPOSITION and self._last() is TokenKind.NOUN and self._tag(-2) in _DESCRIBED:
            self._close()  # "a cloth for wiping the table"
            if after in _OPENS_OBJECT:
                self._emit(TokenKind.PREPOSITION, "purpose")
        elif self.words or before in (Tag.NOUN, Tag.STAND_IN, Tag.AUXILIARY, Tag.RELATIVE):
            self._happening(after)
        else:
            self._emit(TokenKind.VERB, verb_base(word) or word, gerund=True)

    def _happening(self, after: Tag | None) -> None:
        """In "the person holding a cup" the cup is beside the person; in "the cat sleeping here" nothing is."""
        if after in _OPENS_OBJECT:
            self._emit(TokenKind.PREPOSITION, "near")
        else:
            self._close()

    def _participle(self, word: str) -> None:
        before, after = self._tag(-1), self._tag(1)
        if after in _IN_A_NOUN and before not in (Tag.NOUN, Tag.STAND_IN, Tag.PRONOUN):
            self.words.append(word)
            return
        self._end_relative_subject(finite=after is Tag.PRONOUN)
        if self.modal and self._subject_is_thing():
            self._emit(TokenKind.BELONGS, verb_base(word) or word)
        elif after in _OPENS_OBJECT and self._last() is TokenKind.NOUN:
            self.pieces.pop()  # who dropped it is none of the task's business
        self.modal = False

    def _preposition(self, word: str) -> None:
        relation = PREPOSITIONS[word]
        before, after = self._tag(-1), self._tag(1)
        if word == "of" and before is Tag.DETERMINER and not self.words:
            return
        directly = not self.words and self._last() is TokenKind.VERB and before is Tag.VERB
        if directly and is_particle(self.pieces[-1].word, word):
            if relation in _WAYS and self.pieces[-1].word in GO_VERBS:
                self._emit(TokenKind.PREPOSITION, "via")
            return
        if relation == "to" and self._last() is TokenKind.NOUN and (before is Tag.ING or self._tag(-2) is Tag.RELATIVE):
            relation = "purpose"  # "the door that leads to the hall"
        if after is Tag.PREPOSITION or (after is Tag.ING and word in ("for", "by", "before", "after")):
            self._close()
            return
        self._emit(TokenKind.PREPOSITION, relation, stated=before in _STATES)

    def _particle(self, word: str) -> None:
        self._close()
        if word in PREPOSITIONS and (self._tag(1), self._tag(2)) == (Tag.JOIN, Tag.PREPOSITION):
            self._emit(TokenKind.PREPOSITION, PREPOSITIONS[word])  # "under or behind the couch"
