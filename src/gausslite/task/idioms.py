"""Replace English idioms by plain phrases: "get rid of the dust" becomes "remove the dust"."""

from __future__ import annotations

import re
from typing import Final

from gausslite.task.attributes import COLOURS, COMPARATIVES
from gausslite.task.distances import mark_distances

_NUMBER: Final = r"(?:a few|a couple of|several|some|at least|about|one|two|three|four|five|half an?|a|\d+)"
_LENGTH: Final = r"(?:met(?:er|re)s?|feet|foot|steps?|cm|m|inch(?:es)?|paces?|yards?|centimet(?:er|re)s?)"
_DISTANCE: Final = rf"{_NUMBER}(?: (?:one|two|three|a|\d+))? {_LENGTH}"
_PLAIN: Final = {
    # short forms
    r"(it|there|that|what|who|where|here|which|how|he|she)'s": r"\1 is",
    r"(you|we|they)'re": r"\1 are",
    r"(i|you|we|they|it)'(?:ve|d|ll|m)": r"\1",
    rf"at (?:least|most)(?= (?:one|two|three|four|five|six|seven|eight|nine|ten|\d+) (?!{_LENGTH}\b))": "",
    r"(is|are|was|were|does|did|has|have|would|could|should|must)n't": r"\1 not",
    r"let's": "let us",
    # a double negation is a request
    r"(?:do not|don't|dont|never) (?:forget|fail|neglect|omit|hesitate) to": "",
    r"(?:do not|don't|dont|never) (?:forget|skip|ignore|overlook|miss|omit|neglect|leave out|disregard)(?: about)?": (
        "handle"
    ),
    r"(on|in|inside|under|near|behind|at|above) neither (.{2,40}?) nor(?: \1)?": r"not \1 \2 and not \1",
    r"neither (on|in|inside|under|near|behind|at|above) (.{2,40}?) nor (on|in|inside|under|near|behind|at|above)": (
        r"not \1 \2 and not \3"
    ),
    r"face[ -](?:down|up)": "",
    r"there (?:is|are|was|were|should be|must be|might be)(?! (?:not?|any)\b)": "i see",
    r"back(?= where\b)": "",
    r"(?:so|as|very|quite|too) well": "",
    r"reach(?:ing)? for": "grab",
    r"(?:head|make|leave|set off|set out) for(?= (?:the|a|an|my|that|this)\b)": "go to",
    r"(there|where|what|who)s": r"\1 is",
    r"(where|how|what|who)'d": r"\1 did",
    r"u": "you",
    r"take (?:a|two|three|\d+) (?:\w+ )?steps?": "go",
    r"sth|smth": "something",
    r"(?:step|task|item|phase) \d+ ?[:.)]": ";",
    r"(?:there is )?no need to": "do not",
    r", (?:just|only)(?= (?:the|a|an|my)\b)": "; ",
    r"gimme": "give me",
    r"lemme": "let me",
    r"be so (?:kind|good) as to|be (?:kind|good) enough to|in order to": "to",
    r"so(?: that)?(?= (?:i|you|we|he|she|they|it|the|my|our|nobody|no|people|everyone|everybody)\b)": "because",
    # light verbs, whose noun carries the meaning
    r"(?:have|take|get|give me|catch|(?:i|we) (?:would )?(?:like|want|need)) an? (?:\w+ ){0,2}"
    r"(?:look|glance|peek|view) (?:at|of|around|over|into)": "look at",
    r"(?:have|take) an? (?:\w+ )?look(?= (?:under|behind|inside|in|on|for|if|whether)\b)": "look",
    r"(?:take|make) (?:a )?note of|take stock of": "look at",
    r"keep (?:an|your|a close|a watchful) eye on|keep watch (?:over|on)": "watch",
    r"get rid of|do away with|dispose of|throw (?:away|out)": "remove",
    r"(?:take|get) (?:good )?(?:care|hold) of": "handle",
    r"(?:make|find) (?:your|its) way(?= (?:to|towards?|into|through|past|out|back)\b)": "go",
    r"be careful (?:not to|to not)|make sure (?:not to|you don't|to not)|try not to|take care not to": "do not",
    r"(?:watch out|look out|be careful|beware) (?:for|of|with)": "avoid",
    r"(?:stay|keep|steer|remain|stand) (?:well )?(?:clear|away|off) (?:of|from)": "avoid",
    r"keep (?:your|a safe|some|a) distance (?:from|to)": "avoid",
    rf"(?:keep|stay|remain) (?:at least )?{_DISTANCE} (?:away |clear )?(?:from|of)": "avoid",
    r"not (?:\w+ )?far (?:away )?from": "near",
    r"(?:farthest|furthest|most distant) away(?! from)|most distant(?! from)": "farthest",
    r"with no(?= \w)": "without",
    r"(?:ground|first|second|third|fourth|top|upper|lower|next|\d+(?:st|nd|rd|th)) floor\b"
    r"(?! (?:tile|lamp|mat|plan|board))": "storey",
    r"(\w+)-colou?red": r"\1",
    r"across the (?:street|road|hall|hallway|room|corridor|aisle) from": "opposite",
    r"right(?= (?:next|beside|behind|under|above|in front|by|inside|at|below|between|on top)\b)": "",
    r"in (?:a|one) (?:\w+ )?(?:row|line|pile|stack|heap|circle)": "",
    r"pay (?:no|not any) attention to|(?:do not|don't|never) (?:care|worry|bother) (?:about|with)": "ignore",
    r"give (?:\w+ )?priority to|prioriti[sz]e|spend (?:\w+ )*?(?:time|effort|budget) on": "look at",
    r"how (?:far|close|near) (?:is|are) (.{2,60}?) (?:from|to)": r"measure \1 and",
    r"pay (?:\w+ )?attention to|focus (?:only )?on|concentrate on": "look at",
    r"(?:with the exception|to the exclusion) of|other than|but for": "except",
    r"(everything|everyone|all|anything) but": r"\1 except",
    r"as well as|along with|together with|in addition to|and also|plus": "and",
    r"in between": "between",
    r"((?:every|all|any) (?:\w+ ){0,2}\w+) but(?= (?:the|a|an|my|this|that|those) )": r"\1 except",
    # "give the table a wipe": the last noun carries the meaning
    r"give (.{2,60}?) an? (?:\w+ )?(rinse|wipe|wash|clean|scrub|polish|sweep|shake|push|pull|kick|stir)": r"\2 \1",
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
    rf"(?: (?:{_LENGTH}|kg|others?|ones?|high|tall|wide|long)\b)*"
)
_ARROW: Final = re.compile(r"\s*(?:->|=>|\u2192)\s*")
_LEAVE_ALONE: Final = re.compile(
    r"\bleav(?:e|ing) ((?:\w+ ){1,4})(?:alone|untouched|undisturbed|unchanged|in peace|as (?:it is|is|they are)"
    r"|be|for (?:now|later)|where (?:it is|they are))\b"
)


def comparisons(text: str) -> list[str]:
    """Return the comparisons of a normalised text, such as "taller than one metre", which no graph states."""
    return [match[0] for match in _COMPARISON.finditer(text)]


def replace_idioms(text: str) -> str:
    """Return a normalised sentence with idioms replaced."""
    text = _ARROW.sub(" to ", text)
    text = _LEAVE_ALONE.sub(r"do not touch \1", text)
    for idiom, plain in _IDIOMS:
        text = idiom.sub(plain, text)
    text = _COMPARISON.sub("", text)
    return mark_distances(_TWO_COLOURS.sub(r"\1-and-\2", text))
