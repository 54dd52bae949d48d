"""Word lists of the rule parser: nouns, attributes, adverbs, negations, nouns that name no object; plurals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gausslite.domain.nouns import is_thing
from gausslite.domain.task import Superlative
from gausslite.task.verbs import word_set as word_set

COLOURS: Final = word_set(
    "red green blue yellow orange black white grey gray brown pink purple beige silver golden gold turquoise violet "
    "maroon navy crimson scarlet ivory cream tan bronze teal lilac magenta cyan amber khaki indigo"
)
_SHADES: Final = word_set("light dark bright pale deep")
# a colour and a noun that together name another thing
_COLOUR_COMPOUNDS: Final = frozenset(
    tuple(pair.split("_"))
    for pair in word_set(
        "orange_juice orange_soda red_bull orange_tree orange_peel red_wine white_wine green_tea black_tea "
        "black_coffee black_pepper white_bread brown_bread brown_rice brown_sugar white_sugar red_cross blue_cheese "
        "cream_cheese green_bean red_onion green_onion red_cabbage black_box white_board black_board ice_cream "
        "yellow_page gold_fish silver_foil black_hole green_house orange_slice red_meat white_chocolate"
    )
)
_WORDS_OF_SUPERLATIVE: Final = {
    Superlative.LARGEST: "largest biggest hugest greatest larger bigger",
    Superlative.SMALLEST: "smallest tiniest littlest smaller tinier littler",
    Superlative.TALLEST: "tallest taller",
    Superlative.SHORTEST: "shortest shorter",
    Superlative.LONGEST: "longest longer",
    Superlative.WIDEST: "widest wider broadest broader",
    Superlative.NARROWEST: "narrowest narrower",
    Superlative.THICKEST: "thickest thicker fattest fatter",
    Superlative.THINNEST: "thinnest thinner slimmest slimmer",
    Superlative.HIGHEST: "highest topmost uppermost higher",
    Superlative.LOWEST: "lowest bottommost lowermost",
    Superlative.LEFTMOST: "leftmost left-most",
    Superlative.RIGHTMOST: "rightmost right-most",
    Superlative.NEAREST: "nearest closest nearer closer",
    Superlative.FARTHEST: "farthest furthest farther further remotest",
}
SUPERLATIVES: Final = {
    word: superlative for superlative, words in _WORDS_OF_SUPERLATIVE.items() for word in words.split()
}
COMPARATIVES: Final = frozenset(
    word
    for word, superlative in SUPERLATIVES.items()
    if word.endswith("er") and superlative not in (Superlative.NEAREST, Superlative.FARTHEST)
) | word_set("heavier lighter older newer thicker thinner")
DISTANCE_SUPERLATIVES: Final = frozenset({Superlative.NEAREST, Superlative.FARTHEST})
ORDINALS: Final = word_set("first second third fourth fifth sixth seventh eighth ninth tenth last")
_JOINED: Final = "-and-"


@dataclass(frozen=True, slots=True)
class DescribedNoun:
    """A noun phrase without its attributes; unseen: its ordinals, and superlatives that geometry does not show."""

    noun: str
    colour: str | None = None
    superlative: Superlative | None = None
    unseen: tuple[str, ...] = ()


def is_attribute(word: str) -> bool:
    """Return True for words that never stand in a name."""
    return word in SUPERLATIVES or is_unseen(word) or word in ORDINALS or _is_colour(word)


def is_unseen(word: str) -> bool:
    """Return True for the superlative or comparative of a property that geometry does not show: "oldest", "heavier"."""
    ending = next((ending for ending in ("est", "er") if word.endswith(ending)), None)
    if ending is None or word in ADJECTIVES or (ending == "er" and is_thing(word)):
        return word in ("best", "worst")
    stem = word.removesuffix(ending)
    return any(
        adjective in ADJECTIVES
        for adjective in (stem, stem + "e", stem[:-1] + "y") + (stem[:-1],) * (stem[-2:-1] == stem[-1:])
    )


def split_attributes(phrase: str) -> DescribedNoun:
    """Return the noun of a phrase, and its attributes; the head noun always stays."""
    *words, head = phrase.split()
    kept: list[str] = []
    colours: list[str] = []
    unseen: list[str] = []
    superlative: Superlative | None = None
    for at, word in enumerate(words):
        following = words[at + 1] if at + 1 < len(words) else head
        if word in SUPERLATIVES:
            superlative = SUPERLATIVES[word]
        elif is_unseen(word) or (word in ORDINALS and (word, following) != ("first", "aid")):
            unseen.append(word)
        elif (_is_colour(word) and (word, following) not in _COLOUR_COMPOUNDS) or (
            word in _SHADES and _is_colour(following) and at + 1 < len(words)
        ):
            colours.append(word)
        else:
            kept.append(word)
    colour = " ".join(colours).replace(_JOINED, " and ").replace("gray", "grey") or None
    return DescribedNoun(" ".join((*kept, head)), colour, superlative, tuple(unseen))


def _is_colour(word: str) -> bool:
    return all(part in COLOURS for part in word.split(_JOINED))


ROOMS: Final = word_set(
    "kitchen bedroom bathroom office hallway corridor lobby garage basement attic hall lounge closet pantry laundry "
    "garden yard backyard lawn patio balcony warehouse workshop lab laboratory classroom store shop hospital street "
    "sidewalk driveway field park campus courtyard terrace porch entryway foyer study library cafeteria restroom "
    "toilet-room elevator staircase stairwell aisle"
)
COMMON_ANCHORS: Final = word_set(
    "table desk counter countertop shelf bookshelf cabinet cupboard dresser nightstand bench sofa couch bed chair "
    "stool armchair sink stove oven fridge refrigerator dishwasher microwave wall floor ceiling door doorway window "
    "entrance exit gate fence stair stairs ladder fireplace bathtub shower toilet workbench rack sideboard wardrobe "
    "tree building car truck tv television piano pillar column whiteboard blackboard printer island"
)
CONTAINERS: Final = word_set(
    "drawer box bin basket cabinet cupboard closet fridge refrigerator freezer dishwasher oven microwave bag backpack "
    "crate bucket bowl jar suitcase locker wardrobe container carton trunk dumpster sink bathtub pot washer dryer case "
    "pocket purse toolbox chest sack hamper safe mailbox vase envelope package pantry kitchen incubator centrifuge "
    "autoclave cooler canister tin tub barrel van trailer tank pouch satchel rucksack handbag holdall briefcase "
    "carrier cage hutch kennel crib cot pram tote pail caddy cellar shed barn greenhouse tent cubby cubbyhole glovebox "
    "boot cup mug glass bottle can thermos jug pitcher cooker kiln chamber compartment slot hole folder binder hopper "
    "silo casket coffin wallet quiver holster sheath sleeve wrapper packet sachet pack bundle bathroom bedroom office "
    "garage room car truck lorry bus ambulance helicopter boat plane taxi train"
)
# nouns that are also verbs or adjectives, or that the vocabulary lacks
_OBJECTS: Final = word_set(
    "glass spoon sponge dish grill orange milk water book document monitor headphones light watch tape painting plant "
    "rock puddle sand litter dust stain spill recycling cart truck sign post switch plug handle vent pump hammer drill "
    "saw nail screw bolt hose mop vacuum brush shovel rake block dice frisbee t-shirt tshirt cap jeans dress keychain "
    "ring tie pedestrian pet animal comb package hook stand electronics supply article belonging valuables step crack "
    "leak exit dock tag whiteboard ladle whisk yoga sleeping usb drive cd dvd swing slide wheel weed log seed tap "
    "drain metal spring coil seat pad notepad label stamp coin money cash ticket passport badge lighting wrap weld "
    "cover lift clip clamp peg grip splash seal strap latch hatch winch hoist drop iron polish spray paint oil grease "
    "wax trap track guard guide print sketch note pack file pass switchgear stick mail patch building house head cream "
    "eye hand age"
)
NOUNS: Final = (
    _OBJECTS
    | ROOMS
    | COMMON_ANCHORS
    | CONTAINERS
    | frozenset({"object", "thing", "item", "stuff", "obstacle", "obstruction", "clutter", "hazard", "target"})
)


DETERMINERS: Final = word_set(
    "a an the this that these those my your his her its our their any some all every each both several many few "
    "another other others more much enough whole entire one two three four five six seven eight nine ten eleven twelve "
    "zero dozen most various different multiple single either whichever first second third last next following same "
    "such"
)
# indefinite pronouns, with the noun that a graph uses for them
INDEFINITE_PRONOUNS: Final = {
    "something": "object", "anything": "object", "everything": "object", "someone": "person", "anyone": "person",
    "everyone": "person", "somebody": "person", "anybody": "person", "everybody": "person", "what": "object",
    "whatever": "object", "nothing": "object", "nobody": "person", "whoever": "person",
}  # fmt: skip
# an ordinal that is part of a compound noun
COMPOUND_OPENERS: Final = frozenset({("first", "aid"), ("second", "hand")})
# irrelevant to the graph; most other adverbs end in -ly
ADVERBS: Final = word_set(
    "please so yo pls plz thx ta cheers hey ok okay hello hi yes no-one thanks thank just now also too again very "
    "so-so here there else sure still already yet always almost instead fast soon later today tonight tomorrow earlier "
    "yesterday sometime sometimes whenever maybe perhaps straight about nearly nearby anywhere somewhere together "
    "alone afterwards even ever quite rather pretty otherwise therefore however anyway indeed twice possible necessary "
    "ago overhead halfway only able um uh asap er erm hmm oh"
)
# names and forms of address for the robot
ADDRESSEES: Final = word_set(
    "robot agent arm gripper bot dear darling sweetheart honey mate buddy sir madam pal friend"
)

# nouns that refer to the task itself: "the goal is to", "any idea where"
TASK_NOUNS: Final = word_set("task mission goal job aim duty idea clue question problem help chance")
# nouns for places and properties: the object follows "of", or there is none
PLACES: Final = word_set(
    "scene environment surroundings room area world space place vicinity workspace view region zone spot location site "
    "map surface home floorplan indoors outdoors way side corner middle center centre top bottom edge end front back "
    "rear left right half part rest remainder interior inside outside distance position pose state status condition "
    "direction everywhere background foreground sight ground-truth height level perimeter neighbourhood neighborhood "
    "premises presence existence absence geometry details detail underside topside exterior tip lot size colour color "
    "shape temperature humidity smell speed damage wear corrosion safety progress time purpose pressure voltage moment "
    "minute hour day week morning afternoon evening night noon bother trouble favour favor kindness matter texture "
    "appearance structure"
)
# after a preposition and without an article they express manner or purpose: by hand, for lunch, in order
MANNER_NOUNS: Final = word_set(
    "hand order name care noon night lunch dinner breakfast work help fun need turn number type kind letter ease "
    "caution love sleep school total general advance bulk use case detail pair fire mistake chance hurry place focus "
    "bloom resolution quality"
)
TIME_NOUNS: Final = word_set(
    "date metre meter centimetre centimeter inch foot percent degree second idea problem reason question job sun rain "
    "shade dark visit trip way party step age"
)
ROUTES: Final = word_set("path way route road course trajectory passage line shortcut track trail")
MEASURES: Final = word_set(
    "picture photo photograph image video model reconstruction kind type sort piece pair set group pile stack lots "
    "number row bunch couple list total cluster collection copy amount view scan map sample none instance instances "
    "section suit bit heap batch handful slice lump chunk strip loaf record inventory close-up closeup overview weight "
    "content"
)
# measures and places that a robot can also be asked to handle: "bring me the list"
PHYSICAL_MEASURES: Final = word_set("picture photo photograph map list model record sample copy")
# places that are also physical objects, unless "in" or "to" precedes them
PHYSICAL_PLACES: Final = word_set("home corner site front back")
PICTURES: Final = word_set("picture photo photograph image painting drawing poster portrait sketch statue")
BUILDINGS: Final = word_set("building house apartment")
# spaces around the robot, which state a context and no anchor; other rooms of the lexicon are objects
_SPACES: Final = (ROOMS - word_set("closet elevator staircase street sidewalk lawn driveway laundry")) | word_set(
    "building house apartment school hotel supermarket restaurant cafe gym church museum airport station terminal mall "
    "theatre theater cinema factory hangar farm clinic ward showroom storeroom stockroom mailroom washroom cloakroom "
    "ballroom courtroom playroom storey depot vestibule atrium mezzanine veranda conservatory greenhouse barn cellar "
    "loft nursery playground meadow forest woods beach orchard vineyard plaza town city village canteen cleanroom "
    "darkroom sunroom dormitory gallery auditorium gymnasium studio home villa pharmacy bakery mudroom zoo stadium den "
    "sauna"
)
_SPACE_HEADS: Final = word_set("room area lot hall park site zone storey wing department section suite court space")


def is_space(words: tuple[str, ...]) -> bool:
    """Return True if a noun phrase is a room or a place: "kitchen", "parking lot", "living room"."""
    named = [word for word in words if not word[0].isdigit()] or list(words)
    return named[-1] in _SPACES or (len(words) > 1 and named[-1] in _SPACE_HEADS)


# defects that an inspection searches for in an object
BODY_PARTS: Final = word_set("hand hands arm arms finger fingers gripper grippers")
DEFECTS: Final = word_set(
    "leak crack dent scratch rust stain hole corrosion damage wear tear mold mould rot chip blockage fault defect "
    "wetness gap fraying blister failure error hazard sign pest disease"
)
PEOPLE: Final = word_set(
    "person people man woman child baby kid human pedestrian worker patient visitor guest user operator nurse doctor "
    "technician someone anyone everyone somebody anybody everybody who whoever"
)
CLOTHING: Final = word_set(
    "jacket coat shirt vest hat dress suit t-shirt tshirt uniform trousers jeans skirt sweater jumper hoodie cap scarf "
    "gown apron overalls shorts boots shoes helmet blouse cardigan pullover costume kilt"
)
PARTS: Final = word_set(
    "handle leg lid knob button screen cable door wheel seat armrest drawer shelf cap label display spout hinge arm "
    "edge rim cover panel switch lock base"
)
# tools to take something with
HELD_TOOLS: Final = word_set(
    "tongs gripper tweezers cart trolley tray glove gloves pliers forklift magnet shovel spoon fork net scoop hook "
    "wheelbarrow ladder pallet-jack claw arm suction dolly towel cloth oven-mitt mitt crane rope winch"
)
GENERIC: Final = word_set("object thing item stuff obstacle obstruction clutter hazard debris target")

ADJECTIVES: Final = COLOURS.union(SUPERLATIVES) | word_set(
    "dark light bright big small large little tiny huge tall short long wide narrow thick thin round square flat heavy "
    "old new broken clean dirty dusty wet dry empty full open closed wooden metal metallic plastic glass ceramic "
    "leather soft hard damaged fragile hot cold warm clear transparent striped loose left right upper lower top bottom "
    "front back rear suspicious unknown dangerous moving static movable fallen spilled unused used relevant important "
    "free main far deep shallow strong weak loud quiet fresh stale ripe raw sharp blunt smooth rough sticky greasy "
    "muddy rusty shiny plain spare extra quarter double missing electric electronic wireless portable safe unsafe sick "
    "ill tired busy young elderly friendly oily curly woolly silly early local nice good bad fine great pretty cute "
    "cheap expensive high low foreign modern ancient antique tidy messy woollen rubber steel iron brass copper cotton "
    "concrete vertical horizontal upright final initial original correct proper exact current previous fast slow "
    "sturdy cool rich easy fancy simple poor late"
)

# words that always exclude the following noun or verb
_EXCLUDING: Final = (
    "without|neither|nor|do not|don't|dont|never|ignore|ignoring|except for|except|excluding|exclude|"
    "but not|not to|not|other than|rather than|instead of|apart from|aside from|skip|skipping|disregard|"
    "disregarding|besides|must not|should not|leave out|leaving out|avoid touching|avoid hitting|"
    "forget about|forget|doesn't|can't|cannot|shouldn't|mustn't|omit|neglect|avoid bumping"
)
NEGATIONS: Final = frozenset(tuple(negation.split()) for negation in _EXCLUDING.split("|"))


_IRREGULAR: Final = dict(
    pair.split(":")
    for pair in word_set(
        "people:person men:man women:woman children:child feet:foot teeth:tooth mice:mouse geese:goose shelves:shelf "
        "bookshelves:bookshelf knives:knife leaves:leaf loaves:loaf scarves:scarf halves:half wolves:wolf lives:life "
        "buses:bus lenses:lens viruses:virus cacti:cactus dice:dice dies:die tvs:tv cds:cd dvds:dvd pcs:pc ties:tie "
        "pies:pie cookies:cookie brownies:brownie movies:movie hoodies:hoodie selfies:selfie potatoes:potato "
        "tomatoes:tomato mangoes:mango heroes:hero caches:cache aches:ache axes:axe persons:person gases:gas "
        "calves:calf humans:human rubbish:rubbish quizzes:quiz policemen:policeman workmen:workman"
    )
)
# words that singular() returns unchanged: plural in form only, or singular with a final s
UNCHANGED: Final = word_set(
    "scissors forceps glasses sunglasses eyeglasses headphones earphones pants jeans trousers shorts pliers tongs "
    "tweezers binoculars goggles clothes stairs valuables electronics groceries gas bus lens news series species "
    "thermos asbestos christmas canvas atlas chaos always mass pass chess press cutlery pajamas pyjamas overalls "
    "tights leggings clippers shears remains goods supplies premises outdoors upstairs downstairs"
)


def singular(word: str) -> str:
    """Return the singular of a lower-case English word, or the word itself if it has none."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word in UNCHANGED or len(word) <= 3 or not word.endswith("s") or word.endswith(("ss", "us", "is", "'s")):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("sses", "xes", "ches", "shes", "zzes")):
        return word[:-2]
    return word[:-1]
