"""Word lists of the rule parser: determiners, adverbs, adjectives, negations, and nouns that name no object."""

from __future__ import annotations

from typing import Final

from gausslite.task.nouns import COMMON_ANCHORS, CONTAINERS, NOUNS, ROOMS
from gausslite.task.word_set import word_set

__all__ = ["COMMON_ANCHORS", "CONTAINERS", "NOUNS", "ROOMS"]


DETERMINERS: Final = word_set(
    "a an the this that these those my your his her its our their any some all every each both several many few "
    "another other others more much enough whole entire one two three four five six seven eight nine ten eleven "
    "twelve zero dozen most various different multiple single either whichever first second third last next following "
    "same such"
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
    "please so kindly yo pls plz thx ta cheers hey ok okay hello hi yes no-one thanks thank quickly slowly just now "
    "also too again very really so-so here there else sure still already yet always currently almost instead fast "
    "soon later today tonight tomorrow yesterday sometime sometimes whenever maybe perhaps probably certainly exactly "
    "directly straight precisely about approximately roughly nearly nearby anywhere somewhere together alone "
    "afterwards finally firstly even ever quite rather pretty otherwise therefore however anyway indeed twice "
    "possible necessary ago overhead only able"
)
# gerunds that begin a compound noun: the charging station, a washing machine
COMPOUND_GERUNDS: Final = word_set(
    "charging washing loading parking dining living drying cutting swimming sleeping ironing changing sewing vending "
    "reading shopping rocking recycling cooking baking frying mixing serving waiting meeting fishing watering "
    "measuring packing gardening climbing welding milking landing docking lighting heating cooling smoking dressing "
    "soldering chopping rolling mailing filing weighing boarding bowling boxing camping cleaning operating sorting "
    "training knitting polling printing pruning racing riding running sailing seating shaving skipping spinning "
    "steering swinging wedding wrapping writing"
)
# names and forms of address for the robot
ADDRESSEES: Final = word_set(
    "robot agent arm gripper bot dear darling sweetheart honey mate buddy sir madam pal friend"
)

# nouns that refer to the task itself: "the goal is to", "any idea where"
TASK_NOUNS: Final = word_set("task mission goal objective job aim assignment duty idea clue question problem")
# nouns for places and properties: the object follows "of", or there is none
PLACES: Final = word_set(
    "scene environment surroundings room area world space place vicinity workspace view region zone spot location "
    "site map surface home floorplan indoors outdoors way side corner middle center centre top bottom edge end front "
    "back rear left right half part rest remainder interior inside outside distance position pose state status "
    "condition direction everywhere background foreground sight ground-truth height level perimeter neighbourhood "
    "neighborhood premises presence existence absence geometry details detail underside topside exterior tip lot size "
    "colour color shape temperature humidity smell speed damage wear corrosion safety progress time purpose pressure "
    "voltage moment minute hour day week morning afternoon evening night noon bother trouble favour favor kindness "
    "matter texture appearance structure"
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
    "section suit bit heap batch handful slice lump chunk strip loaf record inventory close-up closeup overview "
    "weight"
)
# measures and places that a robot can also be asked to handle: "bring me the list"
PHYSICAL_MEASURES: Final = word_set("picture photo photograph map list model record sample copy")
# places that are also physical objects, unless "in" or "to" precedes them
PHYSICAL_PLACES: Final = word_set("home corner site front back")
BUILDINGS: Final = word_set("building house apartment")
# spaces around the robot, which state a context and no anchor; other rooms of the lexicon are objects
_SPACES: Final = (ROOMS - word_set("closet elevator staircase street sidewalk lawn driveway laundry")) | word_set(
    "building house apartment school hotel supermarket restaurant cafe gym church museum airport station terminal mall "
    "theatre theater cinema factory hangar farm clinic ward showroom storeroom stockroom mailroom washroom cloakroom "
    "ballroom courtroom playroom storey depot vestibule atrium mezzanine veranda conservatory greenhouse barn cellar "
    "loft nursery playground meadow forest woods beach orchard vineyard plaza town city village canteen cleanroom "
    "darkroom sunroom dormitory gallery auditorium gymnasium studio home villa pharmacy bakery mudroom zoo stadium"
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
    "jacket coat shirt vest hat dress suit t-shirt tshirt uniform trousers jeans skirt sweater jumper hoodie cap "
    "scarf gown apron overalls shorts boots shoes helmet blouse cardigan pullover costume kilt"
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

ADJECTIVES: Final = word_set(
    "red green blue yellow orange black white grey gray brown pink purple beige silver golden dark light bright big "
    "small large little tiny huge tall short long wide narrow thick thin round square flat heavy old new broken clean "
    "dirty dusty wet dry empty full open closed wooden metal metallic plastic glass ceramic leather soft hard damaged "
    "fragile hot cold warm clear transparent striped loose left right upper lower top bottom front back rear "
    "suspicious unknown dangerous moving static movable fallen spilled unused used nearest closest relevant important "
    "leftmost rightmost highest lowest biggest largest smallest tallest free main far deep shallow strong weak loud "
    "quiet fresh stale ripe raw sharp blunt smooth rough sticky greasy muddy rusty shiny plain spare extra quarter "
    "double missing electric electronic wireless portable safe unsafe sick ill tired busy young elderly friendly oily "
    "curly woolly silly early local nice good bad fine great pretty cute cheap expensive high low foreign modern "
    "ancient antique tidy messy woollen rubber steel iron brass copper cotton concrete turquoise violet maroon navy "
    "crimson scarlet ivory cream tan bronze teal lilac magenta cyan vertical horizontal upright final initial "
    "original correct proper exact current previous"
)

# words that always exclude the following noun or verb
_EXCLUDING: Final = (
    "without|neither|nor|do not|don't|dont|never|ignore|ignoring|except for|except|excluding|exclude|"
    "but not|not to|not|other than|rather than|instead of|apart from|aside from|skip|skipping|disregard|"
    "disregarding|besides|must not|should not|leave out|leaving out|avoid touching|avoid hitting|"
    "forget about|forget|doesn't|can't|cannot|shouldn't|mustn't|omit|neglect|avoid bumping"
)
NEGATIONS: Final = frozenset(tuple(negation.split()) for negation in _EXCLUDING.split("|"))
