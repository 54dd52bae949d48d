"""Common nouns in the singular. An unknown word may still be an object."""

from __future__ import annotations

from typing import Final

from gausslite.task.word_set import word_set

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
    "crate bucket bowl jar suitcase locker wardrobe container carton trunk dumpster sink bathtub pot washer dryer "
    "case pocket purse toolbox chest sack hamper safe mailbox vase envelope package pantry kitchen incubator "
    "centrifuge autoclave cooler canister tin tub barrel van trailer tank pouch satchel rucksack handbag holdall "
    "briefcase carrier cage hutch kennel crib cot pram tote pail caddy cellar shed barn greenhouse tent cubby "
    "cubbyhole glovebox boot cup mug glass bottle can thermos jug pitcher cooker kiln chamber compartment slot hole "
    "folder binder hopper silo casket coffin wallet quiver holster sheath sleeve wrapper packet sachet pack bundle "
    "bathroom bedroom office garage room car truck lorry bus ambulance helicopter boat plane taxi train"
)
_OBJECTS: Final = word_set(
    "mug cup glass bottle plate bowl fork knife spoon pan pot kettle teapot jug pitcher can jar lid tray napkin towel "
    "sponge cloth soap dish toaster blender grill apple banana orange lemon tomato potato carrot bread food fruit "
    "vegetable sandwich pizza cake cookie egg milk coffee tea juice water snack cereal book notebook magazine "
    "newspaper paper pen pencil marker stapler folder binder envelope letter document laptop computer monitor "
    "keyboard mouse phone cellphone telephone tablet charger cable cord remote printer camera speaker headphones "
    "headset microphone router lamp light bulb clock watch calculator eraser ruler scissors tape pillow cushion "
    "blanket sheet rug carpet mat curtain blind mirror picture painting poster frame vase candle plant flower "
    "flowerpot planter tree bush grass leaf branch rock stone dirt mud puddle sand gravel trash garbage rubbish "
    "litter waste debris dust crumb stain spill recycling cart trolley wheelchair walker stroller bicycle bike "
    "scooter motorcycle car truck van bus vehicle forklift pallet cone barrier bollard sign hydrant extinguisher pole "
    "post pipe valve gauge meter switch socket outlet plug button lever handle knob panel fuse thermostat sensor "
    "detector alarm vent fan heater radiator conditioner boiler tank pump motor engine machine conveyor robot hammer "
    "screwdriver wrench drill saw pliers nail screw bolt nut toolbox tool glove helmet vest goggles rope chain hose "
    "ladder broom mop bucket dustpan vacuum brush shovel rake wheelbarrow mower ball toy doll puzzle block brick dice "
    "card game controller guitar piano drum violin bat racket frisbee kite shoe boot sandal slipper sock shirt "
    "t-shirt tshirt jacket coat hat cap scarf pants jeans dress skirt clothes clothing laundry hanger bag backpack "
    "purse wallet suitcase luggage umbrella key keys keychain glasses sunglasses belt ring necklace tie person people "
    "man woman child baby kid human pedestrian worker patient visitor guest user operator nurse doctor dog cat bird "
    "pet animal horse cow sheep medicine pill medication syringe bandage thermometer mask kit toothbrush toothpaste "
    "comb razor shampoo tissue package parcel box crate carton basket bin barrel container shelf rack locker drawer "
    "hook stand tripod chair table stool bench sofa couch bed crib mattress desk cabinet furniture appliance utensil "
    "cutlery silverware tableware electronics equipment supply device gadget instrument article belonging valuables "
    "stairs step ramp railing rail curb hole crack leak window door wall floor ceiling roof beam column pillar "
    "entrance exit doorway gate fence bridge elevator dock station landmark tag whiteboard coaster saucer straw ladle "
    "spatula whisk corkscrew opener grater strainer colander mitt apron thermos flask canteen dumbbell treadmill yoga "
    "barbell skateboard surfboard snowboard ski tent sleeping cooler lantern flashlight torch battery adapter usb "
    "drive disk disc cd dvd television tv screen projector console antenna modem server mailbox streetlight lamppost "
    "statue fountain swing slide sandbox manhole crosswalk tire wheel weed hedge log stump root seed fertilizer "
    "sprinkler nozzle faucet tap drain gutter chimney tile plank board lumber wood scrap metal wire spring gear "
    "bearing shaft coil circuit breaker transformer inverter seat armrest leg arm edge pad notepad sticker label "
    "stamp coin money bill cash ticket passport badge shed sled doorstep doormat pool bathrobe awning wiring plumbing "
    "piping lighting bedding carving flooring siding scaffolding wrap weld cover lift jack clip clamp peg grip splash "
    "seal strap latch hatch winch hoist crane drop iron polish spray paint oil grease wax trap track guard guide "
    "print sketch note stock pack file pass switchgear stick mail patch emergency building house apartment head cream "
    "weight suit eye ear nose mouth hand foot finger knee neck eyewash age"
)
NOUNS: Final = (
    _OBJECTS
    | ROOMS
    | COMMON_ANCHORS
    | CONTAINERS
    | frozenset({"object", "thing", "item", "stuff", "obstacle", "obstruction", "clutter", "hazard", "target"})
)
