"""The closed sets of words the rule parser knows: verbs by what they do, joining words, and everyday nouns."""

from __future__ import annotations

from typing import Final

from gausslite.task.nouns import CONTAINERS, LANDMARKS, NOUNS, ROOMS
from gausslite.task.words import words

__all__ = ["CONTAINERS", "LANDMARKS", "NOUNS", "ROOMS"]


# verbs by what becomes of the nouns around them
GO_VERBS: Final = words(
    "go navigate drive move walk head proceed travel come approach reach follow cross enter exit return run roll fly "
    "advance get steer park dock explore patrol roam tour wander visit escort"
)
CARRY_VERBS: Final = words(
    "bring take carry deliver fetch hand pass give transport haul transfer relocate send shift drag push pull slide "
    "connect attach plug mount fasten screw glue tape"
)
PLACE_VERBS: Final = words(
    "put place set drop leave stack hang throw load insert pour store stow deposit unload position arrange rest dump "
    "toss lay pile plant"
)
TOOL_VERBS: Final = words(
    "clean wipe vacuum sweep mop wash scrub dust polish rinse disinfect sanitize sanitise tidy brush dry sterilize "
    "declutter organize organise sort clear hoover rake shovel mow paint cut cover spray water repair fix"
)
SEARCH_VERBS: Final = words("look search hunt check scan inspect explore watch scout browse survey examine patrol")
INSPECTION_VERBS: Final = words("check scan inspect survey examine")
OTHER_VERBS: Final = words(
    "pick grab grasp lift hold collect gather retrieve remove catch seize lower raise open close shut press push turn "
    "switch rotate touch hit bump knock break disturb move tilt flip fill empty refill squeeze assemble disassemble "
    "find locate identify detect recognize recognise spot seek discover determine point show tell see view observe "
    "monitor photograph capture record map reconstruct model measure count track list report describe mark label "
    "localize localise avoid dodge evade circumvent bypass pass circle stop wait stay keep mind beware prepare start "
    "begin try help make ensure verify assess evaluate review focus attend concentrate ask use need want know read "
    "test build manipulate handle serve cook feed harvest prune recycle sample sit stand step swap change replace "
    "unplug unlock lock light aim dispose select choose plan compute plot route scoop pour stir tighten loosen mind "
    "document catalog catalogue digitize film image audit compare deliver plow trim weed work gaze steer supply "
    "charge guide lead obstruct harm damage scratch spill scare wake block enter interact collide contact"
)
# "move to the chair" goes there, "move the chair to the door" takes it there
MOVING_VERBS: Final = words("move roll run advance")
# "hand the nurse the towel": the first noun is who gets the second
GIVING_VERBS: Final = words("hand give bring pass fetch get send offer serve show throw feed find grab")
DELIVERY_VERBS: Final = CARRY_VERBS | PLACE_VERBS
VERBS: Final = GO_VERBS | DELIVERY_VERBS | TOOL_VERBS | SEARCH_VERBS | OTHER_VERBS

IRREGULAR_VERBS: Final = {
    "going": "go", "moving": "move", "taking": "take", "putting": "put", "hitting": "hit", "setting": "set",
    "dropping": "drop", "getting": "get", "placing": "place", "approaching": "approach", "leaving": "leave",
    "knocking": "knock", "stepping": "step", "grabbing": "grab", "making": "make", "using": "use", "cutting": "cut",
    "mopping": "mop", "mapping": "map", "scanning": "scan", "locating": "locate", "driving": "drive",
    "disturbing": "disturb", "colliding": "collide", "damaging": "damage", "removing": "remove", "wiping": "wipe",
    "running": "run", "closing": "close", "sitting": "sit", "stopping": "stop", "measuring": "measure",
    "scratching": "scratch", "spilling": "spill", "scaring": "scare", "waking": "wake", "navigating": "navigate",
}  # fmt: skip
# participles that do not end in -ed: "the box left on the table"
IRREGULAR_PARTICIPLES: Final = words(
    "fell went got came stood sat lay ran left kept hidden lost stuck hung laid found put set seen made built held "
    "thrown fallen broken sunk bent spilt"
)
COPULAS: Final = words("is are was were be been being isn't aren't looks seems appears gets stays")

# particles that belong to the verb before them: "pick up", "turn on the lamp", "look at", "search for"
PARTICLES: Final = words("up down off out over away around about back through along past at into across onto for")
ON_IN_PARTICLE_VERBS: Final = words("turn switch power put bring check focus concentrate spot home work plug report")

DETERMINERS: Final = words(
    "a an the this that these those my your his her its our their any some all every each both several many few "
    "another other others more enough whole entire one two three four five six seven eight nine ten dozen most various "
    "different multiple single either whichever first second third last next following same such only"
)
PRONOUNS: Final = words(
    "i me you he him she it we us they them myself yourself itself themselves here there mine yours who whom whose "
    "where when how why which itself themselves"
)
# words that stand for any object or anyone
STAND_INS: Final = {
    "something": "object", "anything": "object", "everything": "object", "someone": "person", "anyone": "person",
    "everyone": "person", "somebody": "person", "anybody": "person", "everybody": "person", "what": "object",
    "whatever": "object", "what's": "object",
}  # fmt: skip
# an ordinal that belongs to a name
COMPOUND_OPENERS: Final = frozenset({("first", "aid"), ("second", "hand")})
FILLERS: Final = words(
    "please could would should can may might must will shall do does did is are was were be been being am has have had "
    "having let lets let's so very really just now then carefully quickly slowly gently safely also too again robot's "
    "kindly hey ok okay hello sure able going gonna ready order task mission job goal as if whether that because while "
    "when once until before after during immediately already still yet always currently possible else necessary "
    "instead fast soon later today tonight tomorrow whenever possible together "
    "nearby visible available present exactly directly right straight precisely approximately about almost "
    "anywhere somewhere together alone afterwards finally firstly next "
    "located standing sitting lying placed resting hanging positioned situated kept found stored leaning mounted "
    "parked seated attached "
    "i'd i'll i'm we're you're there's where's it's that's here's i've we've want wants wanted need needs needed like "
    "likes"
)
CONJUNCTIONS: Final = words("and or , / & plus ; then but +")
SELVES: Final = words("robot drone agent arm gripper rover bot")

# nouns that say where or how, not what: the object is the one after "of", or none at all
PLACES: Final = words(
    "scene environment surroundings room area world space place vicinity workspace view field region zone spot "
    "location site map surface house home building apartment floorplan indoors outdoors way side corner middle center "
    "centre top bottom edge end front back rear left right half part rest remainder interior inside outside distance "
    "position pose state status condition direction everywhere background foreground sight ground-truth height level "
    "perimeter neighbourhood neighborhood premises presence existence absence geometry details detail "
    "underside topside exterior tip lot"
)
# with a noun before them they are a place of their own: the living room, the parking lot
COMPOUND_PLACES: Final = words("room area lot space site zone building house field station spot view")
ROUTES: Final = words("path way route road course trajectory passage line shortcut track trail")
MEASURES: Final = words(
    "picture photo photograph image video model reconstruction kind type sort piece pair set group pile stack lots "
    "number row bunch couple list total cluster collection copy amount view scan map sample none instance instances "
    "section look tour record inventory close-up closeup overview"
)
# places that are solid things too, unless something is in them
SOLID_PLACES: Final = words("building house home corner site front back")
PARTS: Final = words(
    "handle leg lid knob button screen cable door wheel seat armrest drawer shelf cap label display spout hinge arm "
    "edge rim cover panel switch lock base"
)
GENERIC: Final = words("object thing item stuff obstacle obstruction clutter hazard debris target")

ADJECTIVES: Final = words(
    "red green blue yellow orange black white grey gray brown pink purple beige silver golden dark light bright big "
    "small large little tiny huge tall short long wide narrow thick thin round square flat heavy old new broken "
    "clean dirty dusty wet dry empty full open closed wooden metal metallic plastic glass ceramic leather soft hard "
    "damaged fragile hot cold warm clear transparent striped loose left right upper lower top bottom front back rear "
    "suspicious unknown dangerous moving static movable fallen spilled unused used nearest closest relevant important "
    "leftmost rightmost highest lowest biggest largest smallest tallest free main"
)

# words that only ever hide or forbid what comes after them
NEGATIONS: Final = (
    ("without",), ("do", "not"), ("don't",), ("dont",), ("never",), ("ignore",), ("ignoring",), ("except", "for"),
    ("except",), ("excluding",), ("exclude",), ("but", "not"), ("not", "to"), ("not",), ("other", "than"),
    ("rather", "than"), ("instead", "of"), ("apart", "from"), ("aside", "from"), ("skip",), ("skipping",),
    ("disregard",), ("disregarding",), ("besides",), ("must", "not"), ("should", "not"), ("leave", "out"),
    ("leaving", "out"), ("no",), ("avoid", "touching"), ("avoid", "hitting"), ("forget", "about"), ("forget",),
    ("doesn't",), ("can't",), ("cannot",), ("shouldn't",), ("mustn't",), ("omit",), ("neglect",), ("avoid", "bumping"),
)  # fmt: skip
