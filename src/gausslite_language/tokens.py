"""Split a sentence into lexical units: words, prepositions, negations, distances, and idioms as plain phrases."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from gausslite_language import lexicon
from gausslite_language.lexicon import COLOURS, COMPARATIVES
from gausslite_language.verbs import PUSHING_VERBS, TABLES

_NUMBERS: Final[dict[str, float]] = TABLES["numbers"]
# metres by the first letters of a unit
_UNITS_M: Final = (
    ("centi", 0.01), ("cm", 0.01), ("milli", 0.001), ("mm", 0.001), ("f", 0.3048), ("in", 0.0254), ("y", 0.9144),
    ("step", 0.75), ("pace", 0.75), ("m", 1.0),
)  # fmt: skip
_VALUE: Final = rf"(?:\d{{1,4}}(?:[.,]\d{{1,3}})?|{'|'.join(sorted(_NUMBERS, key=len, reverse=True))})(?: and a half)?"
_UNIT: Final = r"(?:(?:centi|milli)?met(?:er|re)s?|cms?|mm|m|feet|foot|ft|inch(?:es)?|yards?|paces?|steps?)"
_MAX: Final = (
    r"within|inside|less than|at most|up to|under|below|a maximum of|max(?:imum)?|(?:closer|nearer) than|"
    r"(?:no|not) (?:more|further|farther|greater)(?: away)? than|not over|(?:no|not) beyond"
)
_MIN: Final = (
    r"at least|more than|over|above|beyond|a minimum of|min(?:imum)?|(?:further|farther)(?: away)? than|"
    r"outside(?: of)?|(?:no|not) (?:less|closer|nearer)(?: away)? than"
)
_LIMIT: Final = r"(?:at (?:least|most)|up to|(?:no|not) (?:more|less|fewer) than)"
_ABOUT: Final = r"about|around|roughly|approximately|approx|some|exactly|nearly|almost|just|only|circa"
# other prepositions that a distance can bound
_BOUNDED: Final = (
    r"behind|in front|left|right|to the|above|below|under|underneath|beneath|over|inside|on the|before|past|after|"
    r"beyond|short"
)
_DISTANCE: Final = re.compile(
    rf"\b(?:at a distance of )?(?:(?P<max>{_MAX})|(?P<min>{_MIN}))?(?: ?\b(?:{_ABOUT}))? ?"
    rf"(?:\bbetween )?\b(?:(?P<low>{_VALUE})(?: ?{_UNIT})?(?: ?- ?| to | and | or ))?(?P<value>{_VALUE}) ?{_UNIT}\b"
    rf"(?P<half> and a half)?(?: or (?P<or>less|more))?(?: (?:away|apart|off|distant))?"
    rf"(?: (?P<link>from|of|to)\b(?! the (?:left|right))|(?= (?:{_BOUNDED})\b))"
)
_UNIT_AFTER: Final = re.compile(rf"{_VALUE} ?(?P<unit>{_UNIT})\b")
_VAGUE: Final = re.compile(
    r"\b(?:a few|several|some|many|various|a number of) (?:met(?:er|re)s?|feet|steps?|paces?|yards?|inch(?:es)?|"
    r"centimet(?:er|re)s?)(?: away)? from\b|\b(?:at )?(?:some|a|a certain|a short|a little) "
    r"(?:distance|way)(?: away)? from\b"
)
# after a number or a unit, a minus sign is a range: "2 -3 m"
_NEGATIVE: Final = re.compile(
    rf"(?:\b(?:{_MAX}|{_MIN}|{_ABOUT}) )*(?:(?<![\w])(?<![\dm] )[-\u2212](?=\d)|\bminus ){_VALUE} ?{_UNIT}\b"
    rf"(?: (?:away|apart|off|distant))?(?: (?:of|from|to)\b)?"
)
_MARKER: Final = re.compile(r"(at|bound)distance_(x|\d+)_(x|\d+)")
VAGUE_MARKER: Final = "vaguedistance"


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of a distance; None where there is none. stands_alone: the marker is a preposition itself, "2 m from"."""

    min_m: float | None = None
    max_m: float | None = None
    stands_alone: bool = False


UNBOUNDED: Final = Bounds()


def mark_distances(text: str) -> str:
    """Return the text with every distance to something replaced by a marker word.

    A negative distance, which nothing has, becomes the marker of a distance without a number.
    """
    return _DISTANCE.sub(_marker, _NEGATIVE.sub(f" {VAGUE_MARKER} ", _VAGUE.sub(f" {VAGUE_MARKER} ", text)))


def bounds_of(marker: str) -> Bounds | None:
    """Return the bounds of a marker word; None for other words."""
    match = _MARKER.fullmatch(marker)
    if match is None:
        return None
    low_m, high_m = (None if text == "x" else int(text) / 100 for text in match.groups()[1:])
    return Bounds(low_m, high_m, match[1] == "at")


def _marker(match: re.Match[str]) -> str:
    link, bounded = match["link"], match["max"] or match["min"] or ""
    if (link == "of" and not bounded.startswith(("within", "inside", "outside"))) or (
        link == "to" and "er than" not in bounded
    ):
        return match[0]
    unit = _UNIT_AFTER.search(match[0], match.start("value") - match.start())
    scale_m = next(metres for start, metres in _UNITS_M if unit is not None and unit["unit"].startswith(start))
    value_m = (_number(match["value"]) + 0.5 * (match["half"] is not None)) * scale_m
    low_m = value_m if match["low"] is None else _number(match["low"]) * scale_m
    is_max = match["max"] is not None or match["or"] == "less"
    is_min = match["min"] is not None or match["or"] == "more"
    low = "x" if is_max else f"{100 * low_m:.0f}"
    high = "x" if is_min else f"{100 * value_m:.0f}"
    return f" {'at' if link else 'bound'}distance_{low}_{high} "


def _number(text: str) -> float:
    whole, and_a_half, _ = text.partition(" and a half")
    value = _NUMBERS[whole] if whole in _NUMBERS else float(whole.replace(",", "."))
    return value + 0.5 * bool(and_a_half)


_PLACED: Final = (
    r"(?:(?:(?:to|on) the (?:left|right)|in front|on top) of|next to|above|below|under|behind|beside|near|in|on)"
)
_END: Final = r"(?: instead)?(?=$| ?[,.;])"
_NAMED: Final = r"(?:the|an?|my|that|this)(?: \w+){1,3}?"
CORRECTION_MARKER: Final = "nowait"
_CORRECTS: Final = (
    r"no,? (?:wait|sorry|no|just|only)|wait,? no|i meant?|(?:scratch|strike|cancel|forget) that(?=[,.;:]| the\b)|"
    r"on second thoughts?|or (?:rather|better)(?: still| yet)?|make (?:that|it)(?= (?:the|an?|my|that)\b)|"
    r"(?:correction|never ?mind|disregard|hold on|hang on)(?=[,.;:])"
)
# only after punctuation, or after another of these
_MAYBE: Final = (
    r"not (?:(?:that|this) \w+|the \w+ ones?)[,;](?: but)?(?= (?:the|my)\b)|"
    r"(?:oh|oops|negative|no|wait|sorry|rather|actually)"
    r"(?=[,.;:]| (?:the|an?|my|that|this|those|these|not|i|no|wait|sorry|make)\b)"
)
_DENIED: Final = r"not the \w+[,;](?= (?:the|my)\b)"
_CORRECTION: Final = re.compile(
    rf"(?:[,.;:]? ?\b(?:{_CORRECTS})|(?:^|[,.;:] )(?:{_MAYBE}))"
    rf"(?:[,.;:]? (?:{_CORRECTS}|{_MAYBE}|{_DENIED}))*[,.;:]?(?= )"
)
_FILLER: Final = re.compile(r"\b(?:h+m+|u[hm]+|erm?|ah|eh)\b,? ")
_DASH: Final = re.compile(r" ?(?:\u2014|\.\.\.| -+ ) ?(?!\d)")
_IDIOMS_DISTANCE: Final = rf"(?:(?:at least|about) )?(?:a few|several|some|{_VALUE}) {_UNIT}"
_PLAIN: Final = {
    # short forms
    r"(it|there|that|what(?:ever)?|who|where|here|which|how|he|she)'s": r"\1 is",
    r"(you|we|they)'re": r"\1 are",
    r"(i|you|we|they|it)'(?:ve|d|ll|m)": r"\1",
    r"gets(?= \w+(?:ed|en|wn)\b)|(?:is|are) to be": "should be",
    r"(is|are|was|were|does|did|has|have|would|could|should|must|need)n't": r"\1 not",
    r"let's": "let us",
    r"(left|right|top|bottom|upper|lower)[ -]most": r"\1most",
    r"^whose": "the",
    r",? ?(?:which|that) belongs? to (?:the |my )?[\w']+,?": "",
    r"^the (?:target|goal|object|item)(?: object)? is(?= (?:an?|the|my|one)\b)": "this is",
    # "a cabinet, above it is a lamp"
    rf"(?:^|(?<=[,.;] ))({_PLACED}) (it|them),? (?:there )?(?:is|are) ([^,.;]+)": r" there is \3 \1 \2",
    r"whose (\w+) (?:is|are) (\w+)": r"with a \2 \1",
    rf"^(?:[\w ]* )?(?:which|what) (\w+(?: \w+)?) (?:(?:is|are|(?:did|do|does|has|have|can) \w+ \w+) ([\w ]{{2,40}}?)|"
    rf"((?:the|my|your) [\w ]{{2,30}}?) (?:is|are))(?: \w+ing)? ({_PLACED}|against)$": (
        r"find the \1 and \2\3 \4 the \1"
    ),
    # a viewpoint: before the description its object may be meant, after it not
    r"(?:(?:if |when |while |as )?(?:you (?:are )?)?(?:facing|looking at)|(?:if|when|as) you (?:face|look at)) "
    r"([\w ]{2,40}),(?: (?:it|that) is)?": r"there is \1;",
    r"tell (?:me|us)": "report",
    rf"((?:{'|'.join(PUSHING_VERBS)}) (?:the|my|an?|this) (?:\w+ ){{0,3}}?\w*[^s\W]) apart from": r"\1 away from",
    r"(?:for (?:instance|example)|e\.g\.?),?|(?:real|super) (?:good|well|fast|quick|slow|careful)": "",
    r",? (?:if|when|while|as)(?: you)?(?: are)? (?:facing|looking(?: at| from)|face|look at|enter|entering) "
    rf"[\w ]{{2,40}}?{_END}": "",
    # what is denied of a place
    rf"(?:do not|don't|never) (\w+ {_NAMED}) ({_PLACED} {_NAMED}),? but ({_PLACED} {_NAMED}){_END}": r"\1 \3, not \2",
    rf"(?:do not|don't|never) ((?:put|place|set|leave|bring|move|store|keep|park) {_NAMED}) (?:any ?where )?(?:near|"
    rf"close to|within {_VALUE} ?{_UNIT} of|(?:any )?(?:closer|nearer) than {_VALUE} ?{_UNIT} (?:to|from))": (
        r"\1 clear of"
    ),
    r"let (the [\w ]+?) (?:stay|be|remain|sleep|rest)(?: where (?:it is|they are))?(?= and\b|$)": r"do not touch \1",
    rf"neither ({_PLACED}|inside|at) (.{{2,40}}?) nor(?= (?:{_PLACED}|inside|at)\b)": r"not \1 \2 and not",
    rf"(stop|wait|halt|pause)(?: just| right| shortly| {_IDIOMS_DISTANCE})? "
    r"(?:(?:before|after|past)(?= (?:the|an?|that|this|it|them)\b)"
    r"|(?:before|when|once|after) you (?:get to|reach|come to|arrive at|hit))": r"\1 at",
    r"out of the way of": "away from",
    r"(?:one|two|three) (?:by|at a) (?:one|two|three|time)|side by side|around the (?:corner|bend)(?! of)": "",
    r"(stop|wait|halt)(?: walking| moving)? (?:once|when|after|as soon as) you(?: are| have)?": r"\1",
    r"(?:and|but) (?:(is|are)(?! (?:the|it|they|there)\b)|(?:it )?(has))": r"and which \1\2",
    r"(^|[.,;] ?|and |but )((?:the|my|an?|those|these|anything) [\w ]*?) ?(?:(?:should|must|can|may|ha(?:s|ve) to) "
    r"(?:stay|remain|be left)|stays?|remains?|\w+ off limits)"
    rf"(?: (?:where|as) \w+ (?:is|are)| there| here| put| in place| untouched)?{_END}": r"\1 do not touch \2",
    rf"(?:any|(?<=look )every)where(?: else)? (?:but|except|other than)(?= (?:{_PLACED}|inside|at|the|my)\b)": ", not",
    r"lacking|devoid of|(?:(?:that |which )?(?:is|are) )?free (?:of|from)|missing(?= (?:an?|its|any|one)\b)": "without",
    r"(?:is|are) no longer|(?<!that )(?<!which )used to be": "is not",
    r"(another|different|other) (\w+(?: \w+)?) (?:than|from)(?= (?:the|my|that)\b)": r"\1 \2 except",
    r"(?:is|are) (?:what|the ones?)(?: that)? (?:i|we|you) (?:want|need|mean|(?:are )?(?:look|search)ing for)": "",
    r"(?:, ?(?:but |and )?|(?:but|and) )(?:only|just)(?: the| those)?(?= (?:\w+ ){1,2}ones?\b)": " ( the",
    r",? ?(?:and |but )?(?:nothing (?:else|more)|(?:ignore|skip) (?:everything|all) else|no others?(?: \w+)?)|"
    r"nothing (?:but|except|other than)|(?:the )?(?:rest|others?) (?:i )?do ?n[o']?t (?:care|matter|mind)": "",
    # where the robot starts gives nothing; a viewpoint is an object to pass
    r"^(?:you (?:stand|are standing|are starting)|(?:you )?(?:start|begin|starting|beginning) (?:at|in|from|by|next))\b"
    r"[^.;,]*[.;,]": "",
    r"(?:until|till|so that|so) (the|an?) ([\w ]{2,30}?) is(?= (?:on|to|at) your| behind you| in front of you)": (
        r"and pass \1 \2"
    ),
    r"so(?: that)? you(?: are)? fac(?:e|ing)": "; face",
    r"(?:is |are )?made (?:out )?of (?:(?:solid|dark|light) )?\w+": "",
    r"(?:could|can|would|will) (?:someone|somebody|anyone|anybody|one of you)|"
    r"(?:might|may|could) i (?:trouble|ask) you to": "please",
    r"(that|it|he|she|who|which)s? (?:is|has) got": r"\1 has",
    r"throw ((?:[\w']+ ){1,9})(?:away|out)(?=$| ?[,.;]| and )": r"remove \1",
    r"(?:to|on) your (?:\w+ )?(?:left|right)(?: hand)?(?: side)?(?! of\b)|back(?= where\b)": "",
    r"(?:on top|at the (?:head|foot))(?! of\b)": "",
    r"on the (?:left|right)(?=,? (?:and )?the\b)|upside down|(?:how|what) about(?= \w+ing\b)|any ?(?:more|longer)": "",
    r"why (?:don't|do not|not)(?: you| we)?": "please",
    r"is it (?:\w+ ){1,2}to(?= \w)|(?:some|any)thing wrong with|do(?:es)? (?:any|some)(?:one|body) know": "",
    rf"(?:until|so(?: that)?) you (?:are standing|are|stand)(?= (?:between|at|by|{_PLACED}|{_VALUE} {_UNIT})\b)": (
        "and stop"
    ),
    r"either(?= (?:in|on|under|at|behind|near|next|inside)\b)|(?:\d+|ninety) degrees?|why(?= (?:is|are)\b)": "",
    r"(?:at the (?:bottom|top),? )?(?:make|take) an? (?:\w+ )?(?:left|right|u-?turn|turn)": "go",
    # a double negation is a request
    r"(?:do not|don't|dont|never) (?:(?:forget|fail|neglect|omit|hesitate) to|just|only|merely|simply)": "",
    r"(?:do not|don't) you(?: dare(?: to)?)?": "do not",
    r"(?:rather|sooner) (?:have |take |you \w+ )?(.{2,40}?) than": r"want \1, not",
    r"prefer (.{2,40}?) (?:over|to)(?= (?:the|an?|my)\b)": r"want \1, not",
    rf"(^|[,;.] |and |but )({_NAMED}) (?:i|we|you) (?:do not|don't|(?:must|should|can) ?not|can't|never) (\w+){_END}": (
        r"\1do not \3 \2"
    ),
    r"(^|[,;.] |and |but )((?:[\w-]+ ){1,4}?)(?:(?:(?:can|may|should|must) be|is|are) )?(?:excepted|excluded|ignored|"
    rf"skipped|left out|omitted|can wait){_END}": r"\1ignore \2",
    r"(?:i (?:would )?(?:love|like|appreciate|prefer) it|it would be \w+) if": "please",
    r"i think(?: it)? is": "it is",
    r"i (?:do not|don't) mean": "not",
    r"i(?: am)? (?:looking|searching)(?: for)?": "find",
    r"(?:al)?though(?: please)?(?= (?:not|do not|don't|leave|skip|no)\b)": "but",
    rf"{_LIMIT} (?:once|twice)|(?:{_LIMIT} )?{_VALUE} times|{_LIMIT}(?= {_VALUE} (?!{_UNIT}\b))": "",
    r"after (?:that|this)(?= \w)": "then",
    r"(?:do ?n[o']?t|never) (?:forget|skip|ignore|overlook|miss|omit|neglect|leave out|disregard)(?: about)?": "handle",
    r"there (?:is|are|was|were|should be|must be|might be)(?! (?:not?|any)\b)|"
    r"(?:^|(?<=[.;,] ))you (?:will )?(?:see|find|notice)": "i see",
    r"(?<=\w )you will (?:see|find|notice)(?= (?:the|an?)\b)": "; i see",
    r"reach(?:ing)? for": "grab",
    r"(?:head|make|leave|set off|set out) for(?= (?:the|a|an|my|that|this)\b)": "go to",
    r"(where|how|what|who)'d": r"\1 did",
    r"take (?:a|two|three|\d+) (?:\w+ )?steps?": "go",
    r", (?:just|only)(?= (?:the|a|an|my)\b)": "; ",
    r"be so (?:kind|good) as to|be (?:kind|good) enough to|in order to": "to",
    r"(?<!^)(?<!^ok )so(?: that)?(?= (?:i|you|we|s?he|they|it|the|my|our|no(?:body)?|people|every\w+)\b)": "because",
    r"(?:have|take|get|give me|catch|(?:i|we) (?:would )?(?:like|want|need)) an? (?:\w+ ){0,2}"
    r"(?:look|glance|peek|view) (?:at|of|around|over|into)": "look at",
    r"(?:have|take) an? (?:\w+ )?look(?= (?:under|behind|inside|in|on|for|if|whether)\b)": "look",
    r"get rid of|do away with|dispose of|throw (?:away|out)": "remove",
    r"(?:you )?(?:need not|(?:do not|don't) (?:have|need) to|are not (?:allowed|permitted) to)|it is forbidden to|"
    r"(?:(?:refrain|abstain|desist|keep|hold back) from|hold off on|no more)(?= \w+ing\b)|tak(?:e|ing) care not to|"
    r"(?:under|in) no (?:circumstance|case)s?(?: should you)?|(?:be|being) careful (?:not to|to not)|by no means|"
    r"make sure (?:not to|you don't|to not)|there is no need (?:for you )?to|try not to|avoid to": "do not",
    r"^(\w+) nothing": r"do not \1 anything",
    r"(?:keep (?:your|the) )?(?:hands|fingers) (?:off|away from)": "do not touch",
    r"prevent (.{2,40}?) to(?= \w)": r"find \1, do not",
    r"in the middle of (?=(?:the|an?) [\w ]{2,30} and (?:the|an?) )": "between ",
    r"(?:keep|stop|prevent) (.{2,40}?) (?:from(?= \w+ing\b)|off(?= (?:the|my|an?)\b))": r"find \1, do not touch",
    r"(?:watch out|look out|be careful|beware) (?:for|of|with)": "avoid",
    r"(?:stay|keep|steer|remain|stand|staying|keeping|steering) (?:well )?(?:clear|away|off) (?:of|from)|"
    r"(?:stay|keep) out of": "avoid",
    r"(?: while)?,? avoiding": ", avoid",
    r"(?:try|take care|be careful|be sure|make sure) (?:to|you)(?= avoid)": "",
    r"give (.{2,60}?) a (?:wide )?berth": r"avoid \1",
    r"(?:stay|keep|remain) close to": "follow",
    r"keep (?:your|a safe|some|a) distance (?:from|to)|(?:stay|keep) off(?: of)?(?= \w)": "avoid",
    rf"(?:keep|stay|remain)(?:ing)? (?:at least )?{_IDIOMS_DISTANCE} (?:away |clear )?(?:from|of)": "avoid",
    r"not (?:\w+ )?far (?:away )?from": "near",
    rf"(?:\w+ (?:floor|level|story))(?= (?:\w+room|{'|'.join(lexicon.ROOMS)})\b)": "",
    r"(?:is|are|am|have run|has run|ran)(?: almost)? out of (?!the\b|my\b)\w+": "is empty",
    r"until you (?:see|find|spot|notice|come to|get to|hit)": "until you reach",
    r"(?:ground|first|second|third|top|upper|lower|next|\w+th|\d+(?:st|nd|rd)) (?:floor|level)\b"
    r"(?! (?:tile|lamp|mat|plan|board))": "storey",
    r"(\w+)-colou?red": r"\1",
    r"across the (?:street|road|hall|hallway|room|corridor|aisle) from": "opposite",
    r"pay (?:no|not any) attention to|(?:do not|don't|never) (?:care|worry|bother) (?:about|with)": "ignore",
    r"how (?:far|close|near) (?:is|are) (.{2,60}?) (?:from|to)": r"measure \1 and",
    r"^(?:(?:get|keep) )?eyes on|(?:zoom in|focus(?: only)?|concentrate) on|pay (?:\w+ )?attention to": "look at",
    r"(?:with the exception|to the exclusion) of|other than|but for": "except",
    r"((?:every|any)(?:thing|one)?|all|(?:every|all|any) (?:\w+ ){0,2}\w+(?= but (?:the|an?|my)\b)) but": r"\1 except",
    r"as well as|along with|together with|in addition to|and also|plus": "and",
}
_IDIOMS: Final = tuple((re.compile(rf"\b(?:{idiom})(?!\w)"), plain) for idiom, plain in _PLAIN.items())
_COLOUR: Final = "|".join(sorted(COLOURS))
# one object with two colours: "a black and white cat", but not "the red and blue mugs"
_TWO_COLOURS: Final = re.compile(
    rf"\b(?:(?<=\ba )|(?<=\bthe )|(?<=\bthat ))({_COLOUR}) and ({_COLOUR})(?= \w*[^s\W]\b)"
)
# no graph states a comparison; comparatives of distance ("further than 2 m from") are no comparisons of objects
_COMPARISON: Final = re.compile(
    rf"\b(?:{'|'.join(sorted(COMPARATIVES))}) than (?:(?:the|an?|my|your|this|that|its|all|any) )*[\w.]+"
    rf"(?: (?:{_UNIT}|kg|kilos?|kilograms?|pounds?|others?|ones?|high|tall|wide|long)\b)*"
)
_ARROW: Final = re.compile(r"\s*(?:->|=>|\u2192)\s*")
_LEAVE_ALONE: Final = re.compile(
    r"\bleav(?:e|ing) ((?:\w+ ){1,4})(?:alone|untouched|undisturbed|unchanged|in peace|as (?:it is|is|they are)"
    r"|be|for (?:now|later)|where (?:it is|they are))\b"
    r"|(?:^|(?<=[,;.] )|(?<=and )|(?<=but )|(?<=please ))leave ((?:\w+ ){1,4}?)(?:on|off|open|closed|shut|running)"
    r"(?=$| ?[,.;]| and | but )"
)
_AHEAD: Final = re.compile(
    rf"\b(walk|move|go|drive|roll|fly|crawl|step|continue|forwards?|ahead|straight|backwards?|back|left|right|for)"
    rf"(?: (?:{_ABOUT}|another))? (?:a few|{_VALUE}) ?{_UNIT}\b(?! (?:from|of|away))"
)


# "a tall, thin lamp"
_LISTED: Final = re.compile(r"\b(an? \w+), (\w+)(?= \w)")
# "the cup (the red one)"
_BRACKETS: Final = re.compile(r"(\w+),? \((?:the |an? )?((?:\w+ )??\w+?)(?: ones?)?\)")


def _described_before(match: re.Match[str]) -> str:
    return f"{match[2]} {match[1]}" if _describes(match[2]) else match[0]


def _joined(match: re.Match[str]) -> str:
    return f"{match[1]} {match[2]}" if _describes(f"{match[1].split()[1]} {match[2]}") else match[0]


def _describes(words: str) -> bool:
    return all(word in lexicon.ADJECTIVES or lexicon.is_attribute(word) for word in words.split())


def comparisons(text: str) -> list[str]:
    """Return the comparisons of a normalised text, such as "taller than one metre", which no graph states."""
    return [match[0] for match in _COMPARISON.finditer(text)]


def replace_idioms(text: str) -> str:
    """Return a normalised sentence with idioms replaced."""
    text = _ARROW.sub(" to ", text)
    text = _LEAVE_ALONE.sub(lambda match: f"do not touch {match[1] or match[2]}", text)
    text = _LISTED.sub(_joined, _BRACKETS.sub(_described_before, text))
    text = _CORRECTION.sub(f" {CORRECTION_MARKER} ", _FILLER.sub("", _DASH.sub(", ", text)))
    for idiom, plain in _IDIOMS:
        text = idiom.sub(plain, text)
    text = _AHEAD.sub(r"\1", _COMPARISON.sub("", text))
    return mark_distances(_TWO_COLOURS.sub(r"\1-and-\2", text))


# a relation that is not a Predicate becomes `near`, with a warning
PREPOSITIONS: Final = {
    words: relation for relation, line in TABLES["prepositions"].items() for words in line.split("|")
} | {VAGUE_MARKER: "at_distance"}


_TOKEN: Final = re.compile(r"[^\W\d_][\w'’-]*|\d[\w.]*|[,/&+;.!?:()]")
_BOUNDS_SIGN: Final = "@"  # no token contains it
_UNITS: Final = [
    *(tuple(preposition.split()) for preposition in PREPOSITIONS if " " in preposition),
    *(negation for negation in lexicon.NEGATIONS if len(negation) > 1),
]
# by their first word, the longest first
_COMPOUNDS: Final = {
    first: sorted((unit for unit in _UNITS if unit[0] == first), key=len, reverse=True)
    for first in {unit[0] for unit in _UNITS}
}


def tokenize(text: str) -> list[str]:
    """Return the lower-case words, the numbers and the relevant punctuation of a text without idioms."""
    return _TOKEN.findall(replace_idioms(text))


def lexical_units(text: str) -> list[str]:
    """Return the tokens of a text, with multi-word prepositions and negations merged."""
    tokens = tokenize(text)
    units: list[str] = []
    start = 0
    bounds = ""
    while start < len(tokens):
        marked = bounds_of(tokens[start])
        if marked is not None:
            bounds = f"{_BOUNDS_SIGN}{tokens[start]}"
            if marked.stands_alone:
                units.append(f"near{bounds}")
                bounds = ""
            start += 1
            continue
        compounds = _COMPOUNDS.get(tokens[start], ())
        length = next((len(unit) for unit in compounds if tuple(tokens[start : start + len(unit)]) == unit), 1)
        if length > 1 and tokens[start + length - 1] == "to" and _begins_preposition(tokens, start + length - 1):
            length -= 1  # "not to the left of"
        unit = " ".join(tokens[start : start + length])
        units.append(unit + bounds if unit in PREPOSITIONS else unit)
        bounds = ""
        start += length
    return units


def split_bounds(unit: str) -> tuple[str, Bounds | None]:
    """Return a preposition without its distance, and the distance."""
    text, _, marker = unit.partition(_BOUNDS_SIGN)
    return text, bounds_of(marker)


def _begins_preposition(tokens: list[str], start: int) -> bool:
    """Return True if a preposition of several words begins here."""
    compounds = _COMPOUNDS.get(tokens[start], ())
    return any(
        " ".join(unit) in PREPOSITIONS and tuple(tokens[start : start + len(unit)]) == unit for unit in compounds
    )
