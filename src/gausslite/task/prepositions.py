"""Prepositions by the relation that they express."""

from __future__ import annotations

from typing import Final

from gausslite.task.distances import VAGUE_MARKER

# a relation that is not a Predicate becomes `near`, with a warning; prepositions are separated by "|"
_BY_RELATION: Final = {
    "near": "near|next to|beside|by|close to|adjacent to|alongside|at|around|against|nearby to|touching|"
    "connected to|in the vicinity of|next|surrounding|along|close by|by the side of|"
    "at the side of|right next to|in reach of|within reach of|leaning on|leaning against|at the end of|"
    "at the foot of|at the base of|at the edge of|on either side of|on both sides of|within arm's reach of|"
    "within easy reach of|tied to|chained to|hooked to|leashed to|plugged into|propped against|"
    "resting against",
    "closer": "closer to",
    "on": "on|all over|scattered over|spread over|"
    "on top of|upon|atop|resting on|on the top of|at the top of|on the surface of|mounted on|on to|"
    "on the side of|attached to|stuck to|stuck on|taped to|glued to|pinned to|nailed to|screwed to|"
    "bolted to|fixed to|fastened to|clipped to|hung on|hanging on|hanging from|hung from|mounted to|"
    "hung up on|hanging off",
    "closest_to": "closest to|nearest to|nearest|closest|most close to|nearest from|closest from",
    "farthest_from": "farthest from|furthest from|farthest to|farthest away from|furthest away from|most distant from|"
    "furthest to",
    "far_from": "far from|away from|far away from|clear of|far off",
    "at_distance": VAGUE_MARKER,
    "inside": "in|inside|inside of|within|in the middle of|in the center of|in the centre of|in the corner of",
    "under": "under|underneath|beneath|below|underneath of",
    "above": "above|over",
    "behind": "behind|in back of|at the back of|in the back of|to the rear of|at the rear of|on the other side of|"
    "on the far side of|round the back of|around the back of",
    "in_front_of": "in front of|at the front of|before the front of|ahead of",
    "left_of": "left of|to the left of|on the left of|on the left side of|to the left side of|left to|"
    "on the left-hand side of|on the left hand side of|at the left of|left side of",
    "right_of": "right of|to the right of|on the right of|on the right side of|to the right side of|right to|"
    "on the right-hand side of|on the right hand side of|at the right of|right side of",
    "between": "between|in between|among|amongst|amid",
    "opposite": "opposite|opposite to|across from|facing|opposite of",
    "outside": "outside|outside of|out in front of",
    "beyond": "beyond",
    "past": "past|through|across|via|up|down",
    "when": "before|after|during|like|until|since|despite|per",
    "from": "from",
    "from_on": "off|off of|from the top of|from on top of|from atop",
    "from_under": "out from under|out from underneath|from under|from underneath|from below|from beneath",
    "from_inside": "out of|from inside|from within|from inside of|from out of",
    "from_behind": "from behind|out from behind",
    "from_near": "from near|from beside|from next to",
    "to": "to|into|onto|toward|towards|up to|over to|back to|all the way to|down to|inside to|out to",
    "for": "for",
    "of": "of",
    "with": "with|using|by means of|by using",
}
PREPOSITIONS: Final = {words: relation for relation, line in _BY_RELATION.items() for words in line.split("|")}
