"""Choose the part of speech of each word: its possible tags with costs, then the sequence of least cost (Viterbi)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final

from gausslite_language import lexicon, verbs
from gausslite_language.lexicon import UNCHANGED, is_attribute, singular, word_set
from gausslite_language.nouns import is_thing
from gausslite_language.tokens import PREPOSITIONS, split_bounds
from gausslite_language.verbs import TABLES


class Tag(Enum):
    """Parts of speech that the task parser distinguishes.

    PARTICLE: the "up" of "pick up". INFINITIVE: "to". CLAUSE_BREAK: punctuation and words that start a clause.
    INDEFINITE: "something", "who". ANAPHOR: "it", "this" without a noun.
    """

    NOUN = "n"
    ADJECTIVE = "a"
    DETERMINER = "d"
    VERB = "v"
    GERUND = "g"
    PARTICIPLE = "e"
    AUXILIARY = "x"
    PREPOSITION = "p"
    PARTICLE = "t"
    INFINITIVE = "u"
    CONJUNCTION = "c"
    CLAUSE_BREAK = "s"
    RELATIVE = "w"
    PRONOUN = "o"
    INDEFINITE = "i"
    ANAPHOR = "k"
    NEGATION = "q"

    __hash__ = object.__hash__  # members are singletons, and Enum's own hash is slow


# Cost of one tag (column) after another (row); "^" is the start and "." the end of the sentence. Chosen by hand:
# 0 is frequent in English, 10 is occasional, 90 does not occur.
_COSTS: Final = """
   n  a  d  v  g  e  x  p  t  u  c  s  w  o  i  k  q  .
^ 10 10  0  0 10 30  0 10 20 10 20 10 10  0  0 10  0  5
n  8 20 30 20 10 10  5  0  5  5  0  0  0 20 30 30  0  0
a  0  3 40 40  8 10 20  7 15 10  5  7 20 30 40 40  5  7
d  0  0  5 90  7  7 60 20 60 30 30 30 40 50 40 60 40 20
v  5  5  0 30  8 30 40  0  0  5  5  5 20  0  0  0 10  5
g  7  7  0 50 30 30 30  0  0 10 10 10 20  5  3  0 20  5
e  7  7  7 50 30 30 40  0  4 10  7  7 20 10 10 10 10  3
x  5  0  0  0  0  0  5  0  5  0 20 20 20  0  0  0  0 10
p  0  0  0 90 10 20 60 30 30 50 30 30 10  0  0  0 20 20
t 10 10  0 30 30 30 20  0 10  5  0  0 20 10 10 20 10  0
u 90 90 90  0 50 90  0 90 90 90 90 90 90 90 90 90 10 90
c  5  5  0  5  7 15  5  5 20  5  0  0  5  3  5 10  0 10
s  8  8  0  3  5 15  5  5 30 10  0  0  5  0  0 10  0  0
w 25 15  0  0 30  7  0 20 40  5 20 20 20  0  3  0 10 20
o 20 20 15  0 10  3  0  0  0  0  0  0 20 15 10 20  0  0
i 40 20 30 10  7  5  0  0  5  3  0  0  0 10 40 40  0  0
k 40 20 30 20 20 20  5  0  5  5  0  0 10 40 40 40 10  0
q  5  5  0  0  0 10 10 10 30  5 20 20 20  5  0  0 20 20
"""


def _table(text: str) -> dict[Tag | None, dict[Tag | None, int]]:
    """Return the costs by row and column tag; None is the start as a row and the end as a column."""
    header, *rows = [line.split() for line in text.strip().splitlines()]
    columns = [None if name == "." else Tag(name) for name in header]
    return {None if row[0] == "^" else Tag(row[0]): dict(zip(columns, map(int, row[1:]), strict=True)) for row in rows}


TRANSITION_COSTS: Final = _table(_COSTS)


def best_tags(candidates: Sequence[Mapping[Tag, int]]) -> list[Tag]:
    """Return one tag per word that minimises the sum of word costs and transition costs (Viterbi)."""
    paths: dict[Tag | None, int] = {None: 0}
    backpointers: list[dict[Tag, Tag | None]] = []
    for options in candidates:
        reached: dict[Tag | None, int] = {}
        origins: dict[Tag, Tag | None] = {}
        for tag, own_cost in options.items():
            cost, origin = min(
                ((path_cost + TRANSITION_COSTS[before][tag], before) for before, path_cost in paths.items()), key=_cost
            )
            reached[tag], origins[tag] = cost + own_cost, origin
        paths = reached
        backpointers.append(origins)
    last = min(paths, key=lambda tag: paths[tag] + TRANSITION_COSTS[tag][None])
    found: list[Tag] = []
    for origins in reversed(backpointers):
        if last is not None:
            found.append(last)
            last = origins[last]
    return found[::-1]


def _cost(pair: tuple[int, Tag | None]) -> int:
    return pair[0]


Options = dict[Tag, int]

# "go stand", "help clean": the second verb is the instruction
_LEADING_VERBS: Final = word_set("go come help")
_AVOIDS: Final = word_set("avoid avoiding evade evading")
_STOPS: Final = word_set("stop stopping quit quitting cease ceasing")
_ENTERED: Final = word_set("on above past inside to from")
_NEGATED_COMMANDS: Final = frozenset({"do not", "don't", "dont", "never", "not to"})
_USUALLY_VERBS: Final = verbs.GO_VERBS | verbs.TOOL_VERBS | verbs.SEARCH_VERBS | word_set("stop hand")
_NEVER_NOUNS: Final = verbs.GO_VERBS | verbs.words("never_nouns")
# at the start of a clause no things: "stand in front of", "swing left", "stock the shelf"
_ENDS: Final = frozenset({Tag.CLAUSE_BREAK, Tag.CONJUNCTION})
_MODIFIERS: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE, Tag.PARTICIPLE})
_PLACES: Final = word_set("near on inside under above behind in_front_of to")
_INTERJECTIONS: Final = word_set("just please pls plz")
_MOTIONS: Final = verbs.GO_VERBS | verbs.STOPPING_VERBS | word_set("turn pass")
_ARTICLES: Final = frozenset({"a", "an", "the", "my", "your", "every"})
_SUBJECTS: Final = word_set("it they he she i we")
_BE: Final = word_set("is are was were")
_OBJECTS_OF_VERBS: Final = word_set("the a an my it them up")
_BEFORE_NAMES: Final = _ARTICLES | word_set("to at in near from")
_FINITE: Final = word_set("is are was were has have can will")
_AFTER_NAMES: Final = (_FINITE | PREPOSITIONS.keys() | {"", ",", "."}) - {"to"}
_BEFORE_OBJECTS: Final = lexicon.DETERMINERS | {"no"}
_DEMONSTRATIVES: Final = word_set("this these those")
_AROUND: Final = word_set("around under behind along between beneath")
_THE: Final = _ARTICLES | word_set("this these those his her its our their")
_OPENERS: Final = frozenset({"", ",", ".", ";", ":", "and", "then"})
_TURNS: Final = word_set("left right around back up down forward backward straight here there")
_BELONG: Final = word_set("go belong")
_MODIFIER_ENDINGS: Final = ("ing", "ed")
_VERB_PARTICLES: Final = word_set("off up out away down")
_POSSESSIVES: Final = ("'s", "s'")
_NOUNS: Final = lexicon.NOUNS | lexicon.PLACES | lexicon.ROUTES | lexicon.MEASURES | lexicon.PARTS | lexicon.ADDRESSEES
_ADJECTIVE_ENDINGS: Final = ("ful", "ous", "able", "ible", "less", "ish", "most", "ic")
_VERB_ENDINGS: Final = ("ize", "ise", "ify", "ate")
_VERB_OPENINGS: Final = ("re", "un", "dis", "de", "over", "pre", "mis")


def _options(line: str) -> Options:
    return {Tag(part[0]): int(part[1:]) for part in line.split()}


_CLOSED: Final[dict[str, Options]] = (
    {word: {Tag.PREPOSITION: 0} for word in PREPOSITIONS}
    | {" ".join(negation): {Tag.NEGATION: 0} for negation in lexicon.NEGATIONS}
    | {word: {Tag.DETERMINER: 0} for word in lexicon.DETERMINERS}
    | {word: {Tag.INDEFINITE: 0} for word in lexicon.INDEFINITE_PRONOUNS}
    | {word: _options(tags) for tags, line in TABLES["tags"].items() for word in line.split()}
)


def tag_words(units: Sequence[str]) -> list[tuple[str, Tag]]:
    """Return the words with their part-of-speech tags; adverbs are dropped, because no graph needs them."""
    kept = [unit if not is_adverb(unit) else ";" for at, unit in enumerate(units) if _is_kept(units, at)]
    later = (kept[at + 2 : at + 4] if kept[at + 1 : at + 2] != ["the"] else [] for at in range(len(kept)))
    neighbours = zip(["", *kept], kept, [*kept[1:], ""], later, strict=False)
    tagged = list(zip(kept, best_tags([_tag_options(*four) for four in neighbours]), strict=True))
    places = [at for at in range(len(tagged)) if _names_place(tagged, at)]
    return _deny_gerunds([(word, Tag.NOUN if at in places else tag) for at, (word, tag) in enumerate(tagged)])


def _is_kept(units: Sequence[str], at: int) -> bool:
    """Return False for an adverb, unless it starts an instruction: "avoid the stairs just get the ball"."""
    starts = units[at] in _INTERJECTIONS and at > 0 and _is_noun(units[at - 1])
    return (starts and units[at + 1 : at + 2] != [] and units[at + 1] in verbs.VERBS) or not is_adverb(units[at])


def _names_place(tagged: Sequence[tuple[str, Tag]], at: int) -> bool:
    """Return True for a gerund that ends a bare place: "in visitor parking", "near shipping"."""
    if tagged[at][1] is not Tag.GERUND or (at + 1 < len(tagged) and tagged[at + 1][1] not in _ENDS):
        return False
    start = at - 1
    while start >= 0 and tagged[start][1] in _MODIFIERS and singular(tagged[start][0]) == tagged[start][0]:
        start -= 1
    word, tag = tagged[max(start, 0)]
    return tag is Tag.PREPOSITION and word != "by" and PREPOSITIONS.get(word) in _PLACES


def _deny_gerunds(tagged: list[tuple[str, Tag]]) -> list[tuple[str, Tag]]:
    """Return the words with "avoid" and "stop" before a gerund as negations, unlike "stop driving at the gate"."""
    read: list[tuple[str, Tag]] = []
    ends = [("", Tag.CLAUSE_BREAK)] * 2
    for (word, tag), (gerund, next_tag), (place, _) in zip(
        tagged, [*tagged, *ends][1:], [*tagged, *ends][2:], strict=False
    ):
        relation = PREPOSITIONS.get(split_bounds(place)[0], "on")
        stops_there = verbs.base_of_ing(gerund) in verbs.GO_VERBS and relation not in _ENTERED
        denies = word in _AVOIDS or (word in _STOPS and not stops_there)
        if not denies or tag not in (Tag.VERB, Tag.GERUND) or next_tag is not Tag.GERUND:
            read.append((word, tag))
        elif read and read[-1][1] is Tag.NEGATION:
            read.pop()  # "do not stop wiping"
        else:
            read.append(("do not", Tag.NEGATION))
    return read


def is_adverb(word: str) -> bool:
    """Return True for "carefully", "please" and "clockwise"."""
    if word in lexicon.ADVERBS:
        return True
    ending = word.endswith(("ly", "wise", "wards"))
    return ending and not (
        word in lexicon.ADJECTIVES | verbs.VERBS or singular(word) in _NOUNS or is_thing(word) or word in _CLOSED
    )


def _tag_by_neighbours(before: str, word: str, after: str, later: Sequence[str]) -> Tag | None:
    """Return the tag that a word can only have between these neighbours; None if others are possible."""
    opens, is_place, is_open = before in _OPENERS, after in PREPOSITIONS, word not in _CLOSED
    denying = _STOPS if is_open else _AVOIDS  # "stop moving boxes", "avoid touching"
    ends = not after or is_place or after == "and"
    stops = word in ("stop", "wait") and ends and _is_noun(before) and before not in lexicon.CONTAINERS
    commands = (
        (word == "turn" and after in _TURNS)
        or (word in ("exit", "enter") and before in ("and", "then") and after in _OPENERS)
        or stops  # "walk to the sofa stop", "turn left walk to"
        or (word in verbs.GO_VERBS and before in _TURNS and is_place)
        or (word in verbs.VERBS and before in _LEADING_VERBS | _NEGATED_COMMANDS)
        or (word in verbs.RESTING_VERBS and is_place and _is_noun(before) and singular(before) != before)
        or (opens and word in verbs.TOOL_VERBS and after in _AROUND)
        or (opens and word in verbs.INSPECTION_VERBS and _is_noun(after) and not is_thing(f"{word} {singular(after)}"))
        or (opens and word in verbs.DELIVERY_VERBS and _is_moved(word, after, later))  # ", stack boxes on"
        or (opens and word in _MOTIONS and (is_place or after in _TURNS))
        or (word in verbs.PLACE_VERBS and before in ("and", "then") and is_place)
        or (opens and is_open and word in verbs.VERBS and after in _BEFORE_OBJECTS)
        or (opens and is_open and after in _THE and not word.endswith(_MODIFIER_ENDINGS))  # "fluff the pillow"
        or (opens and word in verbs.VERBS and after in _VERB_PARTICLES)  # "switch off"
        or (before in ("which", "that", "who") and is_place and verbs.base_of_s(word) is not None)  # "which stands on"
        or (before == "you" and is_open and after in lexicon.DETERMINERS)
    )
    named = is_thing(f"{word} {singular(after)}") or is_thing(f"{before} {word}")
    named = named or (before in _BEFORE_NAMES and _is_noun(after))
    waits = opens and word in verbs.STOPPING_VERBS and _is_noun(after) and after not in _CLOSED
    rules = {
        Tag.VERB: commands,
        # "clean socks go in the drawer"
        Tag.ADJECTIVE: (word, after) in lexicon.COMPOUND_OPENERS
        or (opens and _BELONG.intersection(later) and _describes(word) and word in verbs.VERBS),
        Tag.ANAPHOR: word == "that" and not after,
        Tag.RELATIVE: word == "that" and not opens and after in _FINITE,
        Tag.CLAUSE_BREAK: word == "before" and after in _SUBJECTS,
        Tag.NOUN: waits
        or (opens and is_open and after in _BELONG and singular(word) != word)  # "drinks go on the shelf"
        or (before in _DEMONSTRATIVES and word in verbs.VERBS and after in PREPOSITIONS and not _describes(word))
        or (word.endswith("ing") and named)
        or (word == "can" and after not in verbs.VERBS and (after in _AFTER_NAMES or _describes(after)))
        or (word == "half" and after == "of"),  # "stand lamp"
        Tag.PREPOSITION: word == "outside" and after in lexicon.DETERMINERS,
        Tag.GERUND: verbs.base_of_ing(word) is not None and (before in ("without", *_BE) or before in denying),
        Tag.DETERMINER: (word == "one" or word.isdecimal()) and after == "of",
    }
    return next((tag for tag, holds in rules.items() if holds), None)


def _is_moved(verb: str, noun: str, later: Sequence[str]) -> bool:
    """Return True if a bare plural follows the verb, at once or after one word, and then where it goes."""
    plural, place = (noun, later[:1]) if later[:1] and later[0] in PREPOSITIONS else ("".join(later[:1]), later[1:])
    goes = place and place[0] in PREPOSITIONS and PREPOSITIONS[place[0]] not in ("of", "from", "for", "with")
    return bool(goes) and singular(plural) != plural and not is_thing(f"{verb} {singular(noun)}")


def _tag_options(before: str, word: str, after: str, later: Sequence[str]) -> Options:
    text, bounds = split_bounds(word)
    forced = _tag_by_neighbours(before, word, after, later) if bounds is None else Tag.PREPOSITION
    if forced is not None:
        return {forced: 0}
    closed = _CLOSED.get(text)
    if closed is not None:
        return closed
    if after in lexicon.DETERMINERS and before not in _ARTICLES and verbs.base_of_ing(word) is not None:
        return {Tag.GERUND: 0}  # "cleaning the floors"
    if word[0].isdigit() and not word.endswith("up"):  # "7up"
        return {Tag.DETERMINER: 0, Tag.NOUN: 5}
    if word.endswith(_POSSESSIVES) and len(word) > 3:
        return {Tag.ADJECTIVE: 0, Tag.DETERMINER: 0}
    if before in _ARTICLES and (not after or after in PREPOSITIONS) and not _describes(word):
        return {Tag.NOUN: 0}  # "the led"
    is_noun = _is_noun(word)
    options = _verb_options(before, word, is_noun)
    follows_singular = _is_noun(before) and singular(before) == before
    has_object = after in _OBJECTS_OF_VERBS or (_is_noun(after) and word in verbs.words("never_nouns"))
    if Tag.VERB in options and not is_noun and follows_singular and has_object:
        options[Tag.VERB] = -10  # no subject of this form: "the table pick up the cup"
    if _describes(word):
        options[Tag.ADJECTIVE] = 0
    if is_noun:
        options[Tag.NOUN] = 5 if before == "to" and word in _USUALLY_VERBS else 0
    elif options:
        options.setdefault(Tag.NOUN, _noun_cost_of_verb(before, word))
    else:
        options = {
            Tag.NOUN: 5,
            Tag.ADJECTIVE: 1 if word.endswith(_ADJECTIVE_ENDINGS) else 20 if word.endswith("s") else 12,
            Tag.VERB: 40,
        }
    return options


def _describes(word: str) -> bool:
    return word in lexicon.ADJECTIVES or is_attribute(word)


def _is_noun(word: str) -> bool:
    """Return True for a noun of the word lists, and of the vocabulary if it is no form of a known verb."""
    if singular(word) in _NOUNS or word in _NOUNS or word in UNCHANGED:
        return True
    return is_thing(singular(word)) and verbs.verb_base(word) is None and not _describes(word)


def is_english(word: str) -> bool:
    """Return True for a word of the closed classes, the word lists or the vocabulary of nouns."""
    known = word in _CLOSED or is_adverb(word) or _describes(word) or verbs.verb_base(word) is not None
    return known or singular(word) in _NOUNS or is_thing(singular(word)) or word.endswith(_POSSESSIVES)


def _noun_cost_of_verb(before: str, word: str) -> int:
    """Return the cost of a known verb as a noun, which is low after another noun: "a stop button"."""
    if word in lexicon.ADJECTIVES or not before or before in _CLOSED or verbs.verb_base(word) in _NEVER_NOUNS:
        return 30
    return 20 if word.endswith("s") else 12


def _verb_options(before: str, word: str, is_noun: bool) -> Options:
    """Return the tags of the word as a verb form, known or by its ending."""
    options: Options = {}
    if word in verbs.VERBS and not (is_noun and before in _BE):
        usual = not is_noun or (
            word in _USUALLY_VERBS and (before == "to" or (before == "and" and word in verbs.GO_VERBS))
        )
        options[Tag.VERB] = 0 if usual else 5 if word in _USUALLY_VERBS else 12
        if _is_noun(before):  # "the cup bring": a singular noun is not the verb's subject
            options[Tag.VERB] += 8
    elif verbs.base_of_s(word) is not None and before != "to":  # "take it to returns"
        options[Tag.VERB] = 2 if not is_noun else 8 if verbs.base_of_s(word) in _USUALLY_VERBS else 18
    elif not is_noun and (word.endswith(_VERB_ENDINGS) or _prefixed(word)):
        options[Tag.VERB] = 5
    if verbs.base_of_ing(word) is not None:
        options[Tag.GERUND] = 10 if is_noun else 0
    elif word.endswith("ing") and len(word) > 5 and not is_noun:
        options |= {Tag.GERUND: 5, Tag.NOUN: 6}
    if verbs.base_of_ed(word) is not None:
        options[Tag.PARTICIPLE] = 8 if is_noun else 0
    elif word.endswith("ed") and len(word) > 4 and not is_noun:
        options[Tag.PARTICIPLE] = 3
    return options


def _prefixed(word: str) -> bool:
    return any(word.startswith(opening) and word[len(opening) :] in verbs.VERBS for opening in _VERB_OPENINGS)
