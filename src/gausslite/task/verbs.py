"""The vocabulary of verbs: known verbs by the roles that they give to their nouns, and the forms of a verb."""

from __future__ import annotations

from typing import Final


def word_set(text: str) -> frozenset[str]:
    """Return the set of the words of a text."""
    return frozenset(text.split())


GO_VERBS: Final = word_set(
    "go navigate drive move walk head proceed travel come approach reach follow cross enter exit return run roll fly "
    "advance get steer park dock explore patrol roam tour wander visit escort hurry rush climb descend crawl cruise "
    "swim sail land jog race ascend continue reverse veer step swing circle swerve back"
)
CARRY_VERBS: Final = word_set(
    "bring take carry deliver fetch hand pass give transport haul transfer relocate send shift drag push pull slide "
    "connect attach plug mount fasten screw glue tape tow wheel cart ferry lug hoist ship mail forward weld solder "
    "bolt nail clamp tie hook clip pin staple join lead escort guide ride"
)
PLACE_VERBS: Final = word_set(
    "put place set drop leave stack hang throw load insert pour store stow deposit unload position arrange rest dump "
    "toss lay pile plant tuck slip stick wedge shove stuff cram squeeze sprinkle spread scatter bury park fling hurl "
    "lean prop return pack file deploy install transplant tip slide hide ladle scoop spoon funnel drain discard "
    "recycle stash lodge drape embed immerse dip suspend fit pop serve chuck plop shelve "
    # what happens in a place: "warm the mug in the microwave"
    "heat warm cook bake boil fry toast roast microwave chill cool freeze thaw soak keep"
)
TOOL_VERBS: Final = word_set(
    "clean dampen wipe vacuum sweep mop wash scrub dust polish rinse disinfect sanitize sanitise tidy brush dry "
    "sterilize declutter organize organise sort clear hoover rake shovel mow paint cut cover spray water repair fix "
    "hose swab scrape sand iron weed dig sponge steam sterilise wax degrease deice sharpen lubricate oil grease"
)
SEARCH_VERBS: Final = word_set(
    "look search hunt check scan inspect explore watch scout browse survey examine patrol scour comb sift probe"
)
INSPECTION_VERBS: Final = word_set("check scan inspect survey examine test monitor probe assess audit")
LOOKING_VERBS: Final = (
    SEARCH_VERBS | GO_VERBS | word_set("find locate identify detect spot map reconstruct photograph count track avoid")
)
# with and without an object: "move to the chair", "move the chair to the door"
MOVING_VERBS: Final = word_set("move roll run advance return get land park dock drive fly race swing back reverse")
# "stop behind the car": the car is the target
# a room that the robot leaves or crosses
LEAVING_VERBS: Final = word_set("exit leave cross pass traverse")
LEADING_VERBS: Final = word_set("follow escort guide lead accompany")
# the person is the recipient
SPEAKING_VERBS: Final = word_set("tell say speak talk")
STOPPING_VERBS: Final = word_set("stop wait stand stay sit halt pause hover")
TRAVEL_VERBS: Final = GO_VERBS | STOPPING_VERBS
# "hand the nurse the towel": the first noun is the recipient
GIVING_VERBS: Final = word_set(
    "hand give bring pass fetch get send offer serve show throw feed find grab lend buy read toss"
)
# verbs before a gerund that is the instruction: "keep wiping tables", unlike "take folding chairs"
ASPECT_VERBS: Final = word_set(
    "start stop begin keep continue finish mind avoid try resume go come consider need want like help"
)
# "load the van with boxes": the boxes are the target
FILLING_VERBS: Final = word_set("load reload stock restock fill refill")
# "the mugs belong in the cupboard", "the boxes go on the shelf": the subject is the target
BELONGING_VERBS: Final = word_set("belong go come")
# "the shelf that holds the cans": the object is near the subject, unlike "the key that opens the cabinet"
HOLDING_VERBS: Final = word_set(
    "hold contain have carry wear support cover store house surround touch face hug hide show display"
)
# "tape the note on the door", "move the mug to the left of the plate": the place is the destination
ATTACHING_VERBS: Final = word_set(
    "connect attach mount fasten screw glue tape weld solder bolt nail clamp tie hook clip pin staple deliver"
)
PUSHING_VERBS: Final = word_set("move shift push slide drag pull roll nudge place put wheel cart tow")
# "bring the box with the label": what the object has, not a tool
FETCHING_VERBS: Final = word_set(
    "bring take get fetch pick grab give hand pass choose select want need carry show deliver collect retrieve lift"
)
# "the mug that does not stand on the table"
RESTING_VERBS: Final = word_set("hang stand sit lie rest lean")
POSTURE_VERBS: Final = RESTING_VERBS | word_set("belong locate live stick place mount park")
# negated, these mean contact or harm: the object is an obstacle
CONTACT_VERBS: Final = word_set(
    "touch cross hit bump knock collide mess tamper fiddle meddle interfere stamp break damage scratch crush spill "
    "step disturb wake scare move erase strike ram graze trample squash harm hurt shatter smash crash kick nudge tip "
    "topple tread stain rattle interact contact brush scrape dent smudge burn tear rip injure stumble trip startle "
    "frighten endanger tilt overturn upset crack"
)
# the direct object is where the robot goes
REACHING_VERBS: Final = word_set("approach reach enter visit board")
# the robot keeps away from the direct object
AVOIDING_VERBS: Final = word_set("avoid dodge evade circumvent bypass mind beware")
DELIVERY_VERBS: Final = CARRY_VERBS | PLACE_VERBS
# "clean the kitchen": everything in it
COVERING_VERBS: Final = (
    SEARCH_VERBS
    | INSPECTION_VERBS
    | TOOL_VERBS
    | word_set("map reconstruct photograph capture record film model digitize monitor declutter tour roam watch empty")
)
# their object is a thing that exists: "fetch the map", unlike "make a map" and "take a picture"
HANDLING_VERBS: Final = word_set(
    "find locate fetch bring grab pick grasp retrieve collect carry move put place hand pass give deliver lift remove "
    "hang"
)
_OTHER_VERBS: Final = word_set(
    "wobble smile pick grab grasp lift hold collect gather retrieve remove catch lower raise open close shut press "
    "turn switch rotate flip empty assemble disassemble handle feed harvest prune swap change replace unplug unlock "
    "lock light aim stir tighten loosen fold unfold wrap unwrap unpack untie knit drill hammer saw unscrew peel chop "
    "slice dice grate mix blend whisk grill bend straighten stretch trim dress unblock block unclog adjust align "
    "calibrate tune configure uninstall unmount dismount detach unfasten secure unhook latch unlatch unbolt disconnect "
    "refuel recharge replenish top restore update upgrade twist spin swivel wind unwind coil uncoil unroll dim mute "
    "unmute activate deactivate enable disable trigger operate reboot restart reset defrost pet pat steady punch pump "
    "flush pry poke tap grip pinch tug seal unseal cap uncap cork uncork plow plough level shake strip free release "
    "trap rock find locate identify detect recognize spot seek point show tell see view photograph capture record map "
    "reconstruct model measure count track list report describe mark label localize localise verify focus concentrate "
    "read document film image compare log note sketch draw write print type sign highlight tag group estimate weigh "
    "warn alert inform remind ask answer speak talk say call play hear listen smell feel confirm ensure face eye peek "
    "peer avoid stop wait stay mind beware prepare start begin try help make use need want know build sit stand select "
    "choose plan plot route work supply charge obstruct dispose pause resume finish end complete abort halt pursue "
    "jump duck kneel buy sell order rent post save extinguish protect sleep think believe guess wonder expect wish "
    "remember forget let allow remain bother care belong contain own lose live split chew eat drink wear aid apply "
    "bundle center centre cradle dish display eject engage exchange extend grind inflate isolate lace lash line link "
    "outline package pad paste peg pitch pivot preheat receive relay request seat snap snip splash strain strap "
    "surround target tick unbox uncover undo unhitch unveil zip unzip support house wet rid meet welcome invite "
    "introduce accept book nod sprawl fall lie float sink hover skid exist happen leak drip blink beep ring buzz hum "
    "smoke shine function fail grow sprout wave spring collapse forgive thank appear seem become bind"
)
VERBS: Final = (
    GO_VERBS
    | FILLING_VERBS
    | DELIVERY_VERBS
    | CONTACT_VERBS
    | TOOL_VERBS
    | SEARCH_VERBS
    | INSPECTION_VERBS
    | _OTHER_VERBS
)


# past forms and participles that do not end in -ed
_IRREGULAR: Final = dict(
    pair.split(":")
    for pair in word_set(
        "fell:fall fallen:fall went:go gone:go got:get gotten:get came:come stood:stand sat:sit lay:lie laid:lay "
        "lain:lie ran:run left:leave kept:keep hid:hide hidden:hide lost:lose stuck:stick hung:hang found:find put:put "
        "set:set seen:see saw:see made:make built:build held:hold threw:throw thrown:throw broke:break broken:break "
        "sunk:sink bent:bend spilt:spill took:take taken:take gave:give given:give brought:bring bought:buy sent:send "
        "forgot:forget forgotten:forget shut:shut cut:cut hit:hit let:let lit:light wore:wear worn:wear torn:tear "
        "tore:tear woke:wake wrote:write written:write drawn:draw drew:draw grew:grow grown:grow blown:blow blew:blow "
        "swept:sweep wound:wind fed:feed felt:feel led:lead met:meet read:read said:say told:tell sold:sell slid:slide "
        "spread:spread stolen:steal stole:steal frozen:freeze driven:drive drove:drive flown:fly flew:fly eaten:eat "
        "ate:eat drunk:drink drank:drink chosen:choose knew:know known:know thought:think burnt:burn dug:dig "
        "bound:bind dealt:deal heard:hear leant:lean leapt:leap meant:mean shown:show slept:sleep stung:sting "
        "swung:swing done:do lent:lend hurt:hurt sprung:spring woven:weave strewn:strew"
    )
)
_PARTICLES: Final = word_set("up down off out over away around about back through along past at into across onto for")
_SWITCHED_ON: Final = word_set("turn switch power put bring check focus concentrate spot home work plug report")
# after these verbs "in" or "on" is a particle: "bring in the boxes"
_TAKES_AN_OBJECT: Final = DELIVERY_VERBS - GO_VERBS - word_set("rest lean pack slide place hide")


def base_of_s(word: str) -> str | None:
    """Return "hold" for "holds" and "carry" for "carries"; None if no known verb has this form."""
    if word.endswith("ies"):
        return _known(word[:-3] + "y", word[:-1])
    if word.endswith("es"):
        return _known(word[:-2], word[:-1])
    return _known(word[:-1]) if word.endswith("s") else None


def base_of_ing(word: str) -> str | None:
    """Return "sit" for "sitting" and "place" for "placing"; None if no known verb has this form."""
    if word.endswith("ying"):
        return _known(word[:-3], word[:-3] + "e", word[:-4] + "ie")
    return _stem(word[:-3]) if word.endswith("ing") else None


def base_of_ed(word: str) -> str | None:
    """Return the base form of "stacked", "dropped", "carried" or "fallen"; None if no known verb has this form."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word.endswith("ied"):
        return _known(word[:-3] + "y", word[:-1])
    return _stem(word[:-2]) if word.endswith("ed") else None


def verb_base(word: str) -> str | None:
    """Return the base form of a known verb from any of its forms, or None."""
    if word in VERBS:
        return word
    return base_of_s(word) or base_of_ing(word) or base_of_ed(word)


def is_particle(verb: str, word: str) -> bool:
    """Return True if the word belongs to the verb: "on" in "turn on the lamp", "at" in "look at the lamp"."""
    if word in ("on", "in"):
        return verb in _TAKES_AN_OBJECT or (word == "on" and verb in _SWITCHED_ON)
    return word in _PARTICLES and not (word in ("into", "onto") and verb in GO_VERBS)


def _stem(stem: str) -> str | None:
    """Return the known verb of a stem: unchanged, with a silent e, or without a doubled consonant."""
    doubled = len(stem) > 2 and stem[-1] == stem[-2]
    return _known(stem, stem + "e", stem[:-1] if doubled else "")


def _known(*forms: str) -> str | None:
    return next((form for form in forms if form in VERBS), None)
